"""The guides of examples/on_the_machine, followed as far as a test can: built with CMake and run, or compiled against stand-ins for what is not here."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from machines import drive, in_python, samples

from kros.export import export_c

GUIDES = Path(__file__).parents[2] / "examples" / "on_the_machine"
ARDUINO_H = """
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#define A0 0
static uint32_t clock_us;
static uint32_t micros() { return clock_us += 7; }
static uint32_t millis() { return clock_us / 1000; }
static void delay(int) {}
static int analogRead(int) { return 300; }
struct Port {
  void begin(long) {}
  template <class T> void print(T value, int = 0) { printf("%g ", (double)value); }
  void print(char) {}
  void println(const char *text) { puts(text); }
  void println(uint32_t value) { printf("%u\\n", (unsigned)value); }
};
static Port Serial;
"""
RCLCPP_H = """
#pragma once
#include <functional>
#include <memory>
#include <string>
#define RCLCPP_WARN_THROTTLE(logger, clock, period, ...) (void)(clock)
namespace rclcpp {
struct Time {};
struct Clock {};
struct TimerBase { using SharedPtr = std::shared_ptr<TimerBase>; };
template <class T> struct Subscription { using SharedPtr = std::shared_ptr<Subscription<T>>; };
template <class T> struct Publisher { using SharedPtr = std::shared_ptr<Publisher<T>>; void publish(const T &) {} };
struct Node {
  explicit Node(const std::string &) {}
  double declare_parameter(const std::string &, double value) { return value; }
  template <class T> std::shared_ptr<Subscription<T>> create_subscription(const std::string &, int, std::function<void(std::shared_ptr<T>)>) { return {}; }
  template <class T> std::shared_ptr<Publisher<T>> create_publisher(const std::string &, int) { return {}; }
  template <class D> TimerBase::SharedPtr create_wall_timer(D, std::function<void()>) { return {}; }
  Time now() { return {}; }
  int get_logger() { return 0; }
  std::shared_ptr<Clock> get_clock() { return std::make_shared<Clock>(); }
};
inline void init(int, char **) {}
inline void spin(std::shared_ptr<Node>) {}
inline void shutdown() {}
}
"""
JOINT_STATE_H = """
#pragma once
#include <memory>
#include <string>
#include <vector>
#include <rclcpp/rclcpp.hpp>
namespace sensor_msgs { namespace msg {
struct JointState {
  using SharedPtr = std::shared_ptr<JointState>;
  struct { rclcpp::Time stamp; } header;
  std::vector<std::string> name;
  std::vector<double> position, velocity, effort;
};
} }
"""


def run(*command, cwd, **options):
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.skipif(
    shutil.which("cmake") is None or shutil.which("cc") is None, reason="CMake and a C compiler are not on the PATH"
)
def test_the_cmake_project_gives_the_estimates_of_python(tmp_path):
    observer, (y, u) = drive(), samples(300)
    shutil.copytree(GUIDES / "cmake", tmp_path / "project")
    export_c(observer, tmp_path / "project" / "axis", "axis")
    run("cmake", "-S", ".", "-B", "build", cwd=tmp_path / "project")
    run("cmake", "--build", "build", cwd=tmp_path / "project")
    assert "100% tests passed" in run("ctest", cwd=tmp_path / "project" / "build")
    lines = [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in np.hstack([y, u])]
    said = run("build/estimate", "0.3", cwd=tmp_path / "project", input="\n".join(lines) + "\n")
    found = np.array([[float(v) for v in line.split(",")] for line in said.splitlines()])
    wanted, status = in_python(observer, y, u)
    np.testing.assert_allclose(found[:, :3], wanted, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(found[:, 3], status)


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not on the PATH")
def test_the_sketch_and_the_node_compile_against_stand_ins(tmp_path):
    folder = export_c(drive(), tmp_path / "axis", "axis", "float")
    for name, text in (
        ("Arduino.h", ARDUINO_H),
        ("rclcpp/rclcpp.hpp", RCLCPP_H),
        ("sensor_msgs/msg/joint_state.hpp", JOINT_STATE_H),
        ("main.cpp", '#include "axis_sketch.ino"\nint main() { setup(); for (int i = 0; i < 100000; i++) loop(); }\n'),
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    shutil.copy(GUIDES / "arduino" / "axis_sketch" / "axis_sketch.ino", tmp_path)
    run("gcc", "-std=c99", "-c", folder / "axis.c", folder / "axis_selftest.c", cwd=tmp_path)
    strict, objects = (
        ("-std=c++17", "-Wall", "-Wextra", "-Werror", "-I.", f"-I{folder}"),
        ("axis.o", "axis_selftest.o", "-lm"),
    )
    run("g++", *strict, "main.cpp", *objects, "-o", "sketch", cwd=tmp_path)
    assert len(run("./sketch", cwd=tmp_path).splitlines()) > 5
    run("g++", *strict, GUIDES / "ros2" / "src" / "axis_observer.cpp", *objects, "-o", "node", cwd=tmp_path)
