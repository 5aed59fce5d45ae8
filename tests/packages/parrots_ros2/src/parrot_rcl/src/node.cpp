#include <parrot_rcl/node.hpp>

#include <signal.h>

#include <stdexcept>
#include <utility>

#include <rcl/error_handling.h>
#include <rcl/logging.h>
#include <rcl_yaml_param_parser/parser.h>

namespace parrot_rcl {

void expect_ok(rcl_ret_t said, const char* what) {
  if (said != RCL_RET_OK) {
    const std::string words = std::string(what) + ": " + rcl_get_error_string().str;
    rcl_reset_error();
    throw std::runtime_error(words);
  }
}

void forget(rcl_ret_t said) {
  if (said != RCL_RET_OK) {
    rcl_reset_error();
  }
}

void assign(rosidl_runtime_c__String& to, const std::string& words) {
  if (!rosidl_runtime_c__String__assignn(&to, words.data(), words.size())) {
    throw std::bad_alloc();
  }
}

Node::Node(const char* name, int argc, char** argv) {
  rcl_allocator_t allocator = rcl_get_default_allocator();
  // Threads of the middleware leave the signals to the one that waits for them.
  sigset_t ends;
  sigemptyset(&ends);
  sigaddset(&ends, SIGINT);
  sigaddset(&ends, SIGTERM);
  pthread_sigmask(SIG_BLOCK, &ends, nullptr);

  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  expect_ok(rcl_init_options_init(&options, allocator), "options");
  expect_ok(rcl_init(argc, argv, &options, &context_), "joining ROS");
  expect_ok(rcl_init_options_fini(&options), "options");
  expect_ok(rcl_logging_configure(&context_.global_arguments, &allocator), "logging");
  const rcl_node_options_t of_node = rcl_node_get_default_options();
  expect_ok(rcl_node_init(&node_, name, "", &context_, &of_node), "the node");
  expect_ok(rcl_guard_condition_init(&end_, &context_, rcl_guard_condition_get_default_options()), "the end");
  listener_ = std::thread([this, ends] {
    int signal = 0;
    sigwait(&ends, &signal);
    has_ended_ = true;
    forget(rcl_trigger_guard_condition(&end_));
  });
}

Node::~Node() {
  pthread_kill(listener_.native_handle(), SIGTERM);
  listener_.join();
  for (auto& one : subscriptions_) {
    forget(rcl_subscription_fini(&one->subscription, &node_));
  }
  for (auto& service : services_) {
    forget(rcl_service_fini(service.get(), &node_));
  }
  for (auto& publisher : publishers_) {
    forget(rcl_publisher_fini(publisher.get(), &node_));
  }
  forget(rcl_guard_condition_fini(&end_));
  forget(rcl_node_fini(&node_));
  forget(rcl_logging_fini());
  forget(rcl_shutdown(&context_));
  forget(rcl_context_fini(&context_));
}

std::string Node::parameter(const std::string& name, const std::string& otherwise) const {
  rcl_params_t* given = nullptr;
  expect_ok(rcl_arguments_get_param_overrides(&context_.global_arguments, &given), "parameters");
  std::string value = otherwise;
  for (size_t node = 0; given != nullptr && node < given->num_nodes; ++node) {
    const std::string whose = given->node_names[node];
    if (whose != "/**" && whose != rcl_node_get_fully_qualified_name(&node_)) {
      continue;
    }
    const rcl_node_params_t& all = given->params[node];
    for (size_t at = 0; at < all.num_params; ++at) {
      const char* text = all.parameter_values[at].string_value;
      if (name == all.parameter_names[at] && text != nullptr) {
        value = text;
      }
    }
  }
  if (given != nullptr) {
    rcl_yaml_node_struct_fini(given);
  }
  return value;
}

rcl_publisher_t* Node::advertise(const char* topic, const rosidl_message_type_support_t* type) {
  auto publisher = std::make_unique<rcl_publisher_t>(rcl_get_zero_initialized_publisher());
  const rcl_publisher_options_t options = rcl_publisher_get_default_options();
  expect_ok(rcl_publisher_init(publisher.get(), &node_, type, topic, &options), topic);
  publishers_.push_back(std::move(publisher));
  return publishers_.back().get();
}

void Node::add_subscription(const char* topic, const rosidl_message_type_support_t* type, Take take) {
  auto one = std::make_unique<Subscribed>(Subscribed{rcl_get_zero_initialized_subscription(), std::move(take)});
  const rcl_subscription_options_t options = rcl_subscription_get_default_options();
  expect_ok(rcl_subscription_init(&one->subscription, &node_, type, topic, &options), topic);
  subscriptions_.push_back(std::move(one));
}

rcl_service_t* Node::add_service(const char* name, const rosidl_service_type_support_t* type) {
  auto service = std::make_unique<rcl_service_t>(rcl_get_zero_initialized_service());
  const rcl_service_options_t options = rcl_service_get_default_options();
  expect_ok(rcl_service_init(service.get(), &node_, type, name, &options), name);
  services_.push_back(std::move(service));
  return services_.back().get();
}

void Node::add_answering(rcl_service_t* service, std::function<void()> answer) {
  answering_.push_back(std::make_unique<Answering>(Answering{service, std::move(answer)}));
}

void Node::fill(rcl_wait_set_t& set) const {
  expect_ok(rcl_wait_set_clear(&set), "the wait set");
  const auto resized = rcl_wait_set_resize(&set, subscriptions_.size(), 1, 0, 0, answering_.size(), 0);
  expect_ok(resized, "the wait set");
  expect_ok(rcl_wait_set_add_guard_condition(&set, &end_, nullptr), "the wait set");
  for (const auto& one : subscriptions_) {
    expect_ok(rcl_wait_set_add_subscription(&set, &one->subscription, nullptr), "the wait set");
  }
  for (const auto& one : answering_) {
    expect_ok(rcl_wait_set_add_service(&set, one->service, nullptr), "the wait set");
  }
}

void Node::spin() {
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  expect_ok(rcl_wait_set_init(&set, 0, 1, 0, 0, 0, 0, &context_, rcl_get_default_allocator()), "the wait set");
  while (!has_ended_) {
    fill(set);
    const rcl_ret_t said = rcl_wait(&set, -1);
    if (said != RCL_RET_TIMEOUT) {
      expect_ok(said, "waiting");
    }
    // Whoever is called may add others, which come after these.
    const size_t subscriptions = set.size_of_subscriptions;
    const size_t services = set.size_of_services;
    for (size_t at = 0; at < subscriptions; ++at) {
      if (set.subscriptions[at] != nullptr) {
        subscriptions_[at]->take(set.subscriptions[at]);
      }
    }
    for (size_t at = 0; at < services; ++at) {
      if (set.services[at] != nullptr) {
        answering_[at]->answer();
      }
    }
  }
  expect_ok(rcl_wait_set_fini(&set), "the wait set");
}

}  // namespace parrot_rcl
