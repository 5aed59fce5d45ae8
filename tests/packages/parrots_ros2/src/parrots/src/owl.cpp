// Hoots at whom it sees while it is active: a node with a lifecycle, over rcl_lifecycle. It has no topics before it is configured.
#include <parrot_rcl/node.hpp>

#include <exception>
#include <iostream>
#include <string>

#include <lifecycle_msgs/msg/state.h>
#include <lifecycle_msgs/msg/transition_description.h>
#include <lifecycle_msgs/msg/transition_event.h>
#include <lifecycle_msgs/srv/change_state.h>
#include <lifecycle_msgs/srv/get_available_states.h>
#include <lifecycle_msgs/srv/get_available_transitions.h>
#include <lifecycle_msgs/srv/get_state.h>
#include <rcl/error_handling.h>
#include <rcl_lifecycle/rcl_lifecycle.h>
#include <std_msgs/msg/string.h>

using String = PARROT_MESSAGE(std_msgs__msg__String);

// The types of lifecycle_msgs, which are many.
#define OF_LIFECYCLE(NAME) PARROT_MESSAGE(lifecycle_msgs__srv__##NAME)
#define TYPE_OF_LIFECYCLE(NAME) ROSIDL_GET_SRV_TYPE_SUPPORT(lifecycle_msgs, srv, NAME)

using ChangeState = OF_LIFECYCLE(ChangeState_Request);
using StateChanged = OF_LIFECYCLE(ChangeState_Response);
using GetState = OF_LIFECYCLE(GetState_Request);
using CurrentState = OF_LIFECYCLE(GetState_Response);
using GetStates = OF_LIFECYCLE(GetAvailableStates_Request);
using AvailableStates = OF_LIFECYCLE(GetAvailableStates_Response);
using GetTransitions = OF_LIFECYCLE(GetAvailableTransitions_Request);
using AvailableTransitions = OF_LIFECYCLE(GetAvailableTransitions_Response);

namespace {

void tell(lifecycle_msgs__msg__State& to, const rcl_lifecycle_state_t& state) {
  to.id = state.id;
  parrot_rcl::assign(to.label, state.label);
}

void tell(AvailableTransitions& to, const rcl_lifecycle_transition_t* transitions, size_t count) {
  auto& all = to.available_transitions;
  lifecycle_msgs__msg__TransitionDescription__Sequence__fini(&all);
  if (!lifecycle_msgs__msg__TransitionDescription__Sequence__init(&all, count)) {
    throw std::bad_alloc();
  }
  for (size_t at = 0; at < count; ++at) {
    all.data[at].transition.id = static_cast<uint8_t>(transitions[at].id);
    parrot_rcl::assign(all.data[at].transition.label, transitions[at].label);
    tell(all.data[at].start_state, *transitions[at].start);
    tell(all.data[at].goal_state, *transitions[at].goal);
  }
}

class Owl {
public:
  explicit Owl(parrot_rcl::Node& node) : node_(node) {
    const auto options = rcl_lifecycle_get_default_state_machine_options();
    const auto made = rcl_lifecycle_state_machine_init(
        &machine_, node.handle(), ROSIDL_GET_MSG_TYPE_SUPPORT(lifecycle_msgs, msg, TransitionEvent),
        TYPE_OF_LIFECYCLE(ChangeState), TYPE_OF_LIFECYCLE(GetState), TYPE_OF_LIFECYCLE(GetAvailableStates),
        TYPE_OF_LIFECYCLE(GetAvailableTransitions), TYPE_OF_LIFECYCLE(GetAvailableTransitions), &options);
    parrot_rcl::expect_ok(made, "the lifecycle");
    answer();
  }
  ~Owl() { parrot_rcl::forget(rcl_lifecycle_state_machine_fini(&machine_, node_.handle())); }
  Owl(const Owl&) = delete;
  Owl& operator=(const Owl&) = delete;

private:
  void answer() {
    auto& services = machine_.com_interface;
    node_.answer_at<ChangeState, StateChanged>(&services.srv_change_state, [this](auto& request, auto& response) {
      response.success = change(request.transition);
    });
    node_.answer_at<GetState, CurrentState>(&services.srv_get_state, [this](auto&, auto& response) {
      tell(response.current_state, *machine_.current_state);
    });
    node_.answer_at<GetStates, AvailableStates>(&services.srv_get_available_states, [this](auto&, auto& response) {
      const auto& map = machine_.transition_map;
      lifecycle_msgs__msg__State__Sequence__fini(&response.available_states);
      if (!lifecycle_msgs__msg__State__Sequence__init(&response.available_states, map.states_size)) {
        throw std::bad_alloc();
      }
      for (size_t at = 0; at < map.states_size; ++at) {
        tell(response.available_states.data[at], map.states[at]);
      }
    });
    node_.answer_at<GetTransitions, AvailableTransitions>(
        &services.srv_get_available_transitions, [this](auto&, auto& response) {
          const auto* state = machine_.current_state;
          tell(response, state->valid_transitions, state->valid_transition_size);
        });
    node_.answer_at<GetTransitions, AvailableTransitions>(
        &services.srv_get_transition_graph, [this](auto&, auto& response) {
          const auto& map = machine_.transition_map;
          tell(response, map.transitions, map.transitions_size);
        });
  }

  // Makes a transition, by its label if it has one, as rclcpp does; false if the state has no such.
  bool change(const lifecycle_msgs__msg__Transition& wanted) {
    const auto* state = machine_.current_state;
    const auto* transition = wanted.label.size > 0
                                 ? rcl_lifecycle_get_transition_by_label(state, wanted.label.data)
                                 : rcl_lifecycle_get_transition_by_id(state, wanted.id);
    if (transition == nullptr) {
      rcl_reset_error();
      return false;
    }
    const auto id = static_cast<uint8_t>(transition->id);
    parrot_rcl::expect_ok(rcl_lifecycle_trigger_transition_by_id(&machine_, id, true), "a transition");
    if (machine_.current_state->id == lifecycle_msgs__msg__State__TRANSITION_STATE_CONFIGURING) {
      configure();
    }
    const auto done = rcl_lifecycle_trigger_transition_by_label(
        &machine_, rcl_lifecycle_transition_success_label, true);
    parrot_rcl::expect_ok(done, "the end of a transition");
    return true;
  }

  void configure() {
    if (hooted_ != nullptr) {
      return;
    }
    const auto* type = ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, String);
    hooted_ = node_.advertise("hooted", type);
    node_.subscribe<String>("seen", type, [this](const String& seen) {
      if (machine_.current_state->id == lifecycle_msgs__msg__State__PRIMARY_STATE_ACTIVE) {
        String hoot;
        parrot_rcl::assign(hoot.data, "hoo, " + std::string(seen.data.data, seen.data.size));
        parrot_rcl::expect_ok(rcl_publish(hooted_, &hoot, nullptr), "a hoot");
      }
    });
  }

  parrot_rcl::Node& node_;
  rcl_lifecycle_state_machine_t machine_ = rcl_lifecycle_get_zero_initialized_state_machine();
  rcl_publisher_t* hooted_ = nullptr;
};

}  // namespace

int main(int argc, char** argv) {
  try {
    parrot_rcl::Node node("owl", argc, argv);
    const Owl owl(node);
    node.spin();
  } catch (const std::exception& error) {
    std::cerr << error.what() << std::endl;
    return 1;
  }
  return 0;
}
