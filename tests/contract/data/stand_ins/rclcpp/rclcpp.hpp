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
