// Estimates of an axis: takes joint_states and reference, publishes estimate; one step of the observer a period.
#include <chrono>
#include <cmath>
#include <limits>
#include <memory>

#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/joint_state.hpp>

#include "axis.h"

using sensor_msgs::msg::JointState;

class AxisObserver : public rclcpp::Node {
public:
  AxisObserver() : Node("axis_observer") {
    axis_init(&state_);
    const double phase = declare_parameter("phase", missing());
    if (std::isfinite(phase)) {
      axis_set_phase(&state_, static_cast<axis_real>(phase));
    }
    measured_ = create_subscription<JointState>("joint_states", 10, [this](const JointState::SharedPtr message) {
      if (!message->position.empty()) {
        y_[0] = static_cast<axis_real>(message->position[0]);
      }
    });
    reference_ = create_subscription<JointState>("reference", 10, [this](const JointState::SharedPtr message) {
      if (!message->position.empty() && !message->velocity.empty()) {
        u_[0] = static_cast<axis_real>(message->position[0]);
        u_[1] = static_cast<axis_real>(message->velocity[0]);
      }
    });
    estimate_ = create_publisher<JointState>("estimate", 10);
    timer_ = create_wall_timer(std::chrono::duration<double>(AXIS_SAMPLE_PERIOD_S), [this]() { step(); });
  }

private:
  static double missing() { return std::numeric_limits<double>::quiet_NaN(); }

  void step() {
    axis_real x_hat[AXIS_STATES];
    if (!started_) {
      if (!std::isfinite(y_[0])) {
        return;
      }
      axis_reset(&state_, y_);
      started_ = true;
    }
    status_ = axis_step(&state_, y_, u_, x_hat);
    y_[0] = static_cast<axis_real>(missing()); // until the next one arrives; a reference holds

    JointState message;
    message.header.stamp = now();
    message.name = {"axis"};
    message.position = {static_cast<double>(x_hat[0])};
    message.velocity = {static_cast<double>(x_hat[1])};
    message.effort = {static_cast<double>(x_hat[2])};
    estimate_->publish(message);
    if ((status_ & AXIS_UNCERTIFIED) != 0u) {
      RCLCPP_WARN_THROTTLE(get_logger(), *get_clock(), 1000, "outside what the observer is certified for");
    }
  }

  axis_state state_;
  axis_real y_[AXIS_MEASURED] = {static_cast<axis_real>(missing())};
  axis_real u_[AXIS_INPUTS] = {static_cast<axis_real>(missing()), static_cast<axis_real>(missing())};
  uint32_t status_ = 0u;
  bool started_ = false;
  rclcpp::Subscription<JointState>::SharedPtr measured_, reference_;
  rclcpp::Publisher<JointState>::SharedPtr estimate_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int count, char **arguments) {
  rclcpp::init(count, arguments);
  rclcpp::spin(std::make_shared<AxisObserver>());
  rclcpp::shutdown();
  return 0;
}
