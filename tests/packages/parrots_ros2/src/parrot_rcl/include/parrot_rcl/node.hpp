// A node over rcl, ROS 2's library in C: of all that rclcpp has, what the parrots need.
#pragma once

#include <atomic>
#include <functional>
#include <memory>
#include <new>
#include <string>
#include <thread>
#include <vector>

#include <rcl/rcl.h>
#include <rosidl_runtime_c/string_functions.h>

namespace parrot_rcl {

// A message of generated C, from its beginning to its end.
template <typename T, bool (*init)(T*), void (*fini)(T*)>
struct Message : T {
  Message() {
    if (!init(this)) {
      throw std::bad_alloc();
    }
  }
  ~Message() { fini(this); }
  Message(const Message&) = delete;
  Message& operator=(const Message&) = delete;
};

// The message that generated C calls NAME.
#define PARROT_MESSAGE(NAME) parrot_rcl::Message<NAME, NAME##__init, NAME##__fini>

// Throws the words of rcl if it does not say that all is well.
void expect_ok(rcl_ret_t said, const char* what);

// For what may fail at an end: drops the words of rcl.
void forget(rcl_ret_t said);

// Throws if there is no memory for the words.
void assign(rosidl_runtime_c__String& to, const std::string& words);

class Node {
public:
  // Joins the ROS system as the arguments of the program say.
  Node(const char* name, int argc, char** argv);
  ~Node();
  Node(const Node&) = delete;
  Node& operator=(const Node&) = delete;

  rcl_node_t* handle() { return &node_; }

  // What the program was given for a parameter that is a text, or else the other one.
  std::string parameter(const std::string& name, const std::string& otherwise) const;

  rcl_publisher_t* advertise(const char* topic, const rosidl_message_type_support_t* type);

  template <typename M, typename Heard>
  void subscribe(const char* topic, const rosidl_message_type_support_t* type, Heard heard) {
    add_subscription(topic, type, [heard](const rcl_subscription_t* subscription) {
      M message;
      if (rcl_take(subscription, &message, nullptr, nullptr) == RCL_RET_OK) {
        heard(message);
      }
    });
  }

  template <typename Request, typename Response, typename Answer>
  void serve(const char* name, const rosidl_service_type_support_t* type, Answer answer) {
    answer_at<Request, Response>(add_service(name, type), answer);
  }

  // Answers the requests of a service that belongs to somebody else.
  template <typename Request, typename Response, typename Answer>
  void answer_at(rcl_service_t* service, Answer answer) {
    add_answering(service, [service, answer] {
      rmw_request_id_t id;
      Request request;
      if (rcl_take_request(service, &id, &request) == RCL_RET_OK) {
        Response response;
        answer(request, response);
        expect_ok(rcl_send_response(service, &id, &response), "an answer");
      }
    });
  }

  // Works until the program is told to end.
  void spin();

private:
  using Take = std::function<void(const rcl_subscription_t*)>;
  struct Subscribed {
    rcl_subscription_t subscription;
    Take take;
  };
  struct Answering {
    rcl_service_t* service;
    std::function<void()> answer;
  };

  void add_subscription(const char* topic, const rosidl_message_type_support_t* type, Take take);
  rcl_service_t* add_service(const char* name, const rosidl_service_type_support_t* type);
  void add_answering(rcl_service_t* service, std::function<void()> answer);
  void fill(rcl_wait_set_t& set) const;

  rcl_context_t context_ = rcl_get_zero_initialized_context();
  rcl_node_t node_ = rcl_get_zero_initialized_node();
  std::vector<std::unique_ptr<rcl_publisher_t>> publishers_;
  std::vector<std::unique_ptr<Subscribed>> subscriptions_;
  // Those of this node; others are answered, too.
  std::vector<std::unique_ptr<rcl_service_t>> services_;
  std::vector<std::unique_ptr<Answering>> answering_;
  rcl_guard_condition_t end_ = rcl_get_zero_initialized_guard_condition();
  std::atomic<bool> has_ended_{false};
  std::thread listener_;
};

}  // namespace parrot_rcl
