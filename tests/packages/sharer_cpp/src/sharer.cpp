// Works for as long as it is asked to, one call after the other, and counts, one goal at a time, ten a second.
#include <actionlib/server/simple_action_server.h>
#include <ros/ros.h>
#include <sharer_cpp/CountAction.h>
#include <sharer_cpp/Work.h>
#include <unistd.h>

namespace {

using Count = actionlib::SimpleActionServer<sharer_cpp::CountAction>;

bool work(sharer_cpp::Work::Request& request, sharer_cpp::Work::Response& response) {
  ros::WallDuration(request.seconds).sleep();
  char host[256] = {};
  gethostname(host, sizeof host - 1);
  response.who = request.who;
  response.where = host;
  return true;
}

void count(Count& server, const sharer_cpp::CountGoalConstPtr& goal) {
  sharer_cpp::CountResult result;
  result.who = goal->who;
  sharer_cpp::CountFeedback feedback;
  feedback.who = goal->who;
  for (int n = 1; n <= goal->to; ++n) {
    if (server.isPreemptRequested() || !ros::ok()) {
      server.setPreempted(result);
      return;
    }
    result.all.push_back(n);
    feedback.at = n;
    server.publishFeedback(feedback);
    ros::WallDuration(0.1).sleep();
  }
  server.setSucceeded(result);
}

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "sharer");
  ros::NodeHandle node;
  Count counter(node, "count", [&counter](const sharer_cpp::CountGoalConstPtr& goal) { count(counter, goal); }, false);
  counter.start();
  auto worker = node.advertiseService("work", work);
  ros::spin();
}
