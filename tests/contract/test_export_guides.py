"""The guides of examples/on_the_machine, followed as far as a test can: built with CMake and run, or compiled against stand-ins for what is not here."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from machines import drive, in_python, samples

from kros.export import export_c

GUIDES = Path(__file__).parents[2] / "examples" / "on_the_machine"
STAND_INS = Path(__file__).parent / "data" / "stand_ins"


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
    shutil.copytree(STAND_INS, tmp_path, dirs_exist_ok=True)
    shutil.copy(GUIDES / "arduino" / "axis_sketch" / "axis_sketch.ino", tmp_path)
    run("gcc", "-std=c99", "-c", folder / "axis.c", folder / "axis_selftest.c", cwd=tmp_path)
    strict, objects = (
        ("-std=c++17", "-Wall", "-Wextra", "-Werror", "-I.", f"-I{folder}"),
        ("axis.o", "axis_selftest.o", "-lm"),
    )
    run("g++", *strict, "main.cpp", *objects, "-o", "sketch", cwd=tmp_path)
    assert len(run("./sketch", cwd=tmp_path).splitlines()) > 5
    run("g++", *strict, GUIDES / "ros2" / "src" / "axis_observer.cpp", *objects, "-o", "node", cwd=tmp_path)
