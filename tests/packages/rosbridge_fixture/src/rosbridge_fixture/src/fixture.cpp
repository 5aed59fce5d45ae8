// What the suites of rosbridge's clients look for: /add_two_ints, the action /fibonacci, a greeting on /listener once a
// second, /world -> /turtle1 on /tf, and (from roscpp itself) /rosout.
#include <actionlib/server/simple_action_server.h>
#include <actionlib_tutorials/FibonacciAction.h>
#include <ros/ros.h>
#include <rospy_tutorials/AddTwoInts.h>
#include <std_msgs/String.h>
#include <tf2_msgs/TFMessage.h>

namespace {

using Fibonacci = actionlib::SimpleActionServer<actionlib_tutorials::FibonacciAction>;

bool add(rospy_tutorials::AddTwoInts::Request& request, rospy_tutorials::AddTwoInts::Response& response) {
  response.sum = request.a + request.b;
  return true;
}

// One number every tenth of a second, each told as feedback, until there are `order` more than the first two.
void count(Fibonacci& server, const actionlib_tutorials::FibonacciGoalConstPtr& goal) {
  actionlib_tutorials::FibonacciFeedback feedback;
  feedback.sequence = {0, 1};
  actionlib_tutorials::FibonacciResult result;
  ros::Rate rate(10);
  for (int n = 0; n < goal->order; ++n) {
    if (server.isPreemptRequested() || !ros::ok()) {
      result.sequence = feedback.sequence;
      server.setPreempted(result);
      return;
    }
    const auto& sequence = feedback.sequence;
    feedback.sequence.push_back(sequence[sequence.size() - 2] + sequence[sequence.size() - 1]);
    server.publishFeedback(feedback);
    rate.sleep();
  }
  result.sequence = feedback.sequence;
  server.setSucceeded(result);
}

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "fixture");
  ros::NodeHandle node;
  Fibonacci fibonacci(
      node, "fibonacci",
      [&fibonacci](const actionlib_tutorials::FibonacciGoalConstPtr& goal) { count(fibonacci, goal); }, false);
  fibonacci.start();
  auto adder = node.advertiseService("add_two_ints", add);
  auto listener = node.advertise<std_msgs::String>("listener", 10);
  auto greet = node.createTimer(ros::Duration(1.0), [&listener](const ros::TimerEvent&) {
    std_msgs::String greeting;
    greeting.data = "Hello, World";
    listener.publish(greeting);
  });
  auto transforms = node.advertise<tf2_msgs::TFMessage>("tf", 100);
  auto turn = node.createTimer(ros::Duration(0.1), [&transforms](const ros::TimerEvent&) {
    tf2_msgs::TFMessage message;
    message.transforms.resize(1);
    auto& transform = message.transforms[0];
    transform.header.stamp = ros::Time::now();
    transform.header.frame_id = "world";
    transform.child_frame_id = "turtle1";
    transform.transform.rotation.w = 1.0;
    transforms.publish(message);
  });
  ROS_INFO("the fixture is ready");
  ros::spin();
}
