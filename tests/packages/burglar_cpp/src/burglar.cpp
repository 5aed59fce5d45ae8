// Does what ~try asks for. Started with arguments, and no ROS, it does that: `burglar NAME [ARGUMENT]`.
#include <burglar_cpp/Attempt.h>
#include <ros/ros.h>

#include <cstdio>

#include "tries.h"

static bool tryIt(burglar_cpp::Attempt::Request& request, burglar_cpp::Attempt::Response& response) {
  if (request.what.empty()) {
    for (const auto& entry : attempts()) response.report += entry.first + "\n";
    return true;
  }
  for (const Tries* tries : {&attempts(), &appetite()}) {
    auto found = tries->find(request.what);
    if (found == tries->end()) continue;
    Outcome result = found->second(request.argument);
    response.succeeded = result.succeeded;
    response.report = result.report;
    return true;
  }
  response.report = "there is no such thing to try";
  return false;
}

int main(int argc, char** argv) {
  if (argc > 1 && std::string(argv[1]).find(":=") == std::string::npos) {
    burglar_cpp::Attempt::Request request;
    burglar_cpp::Attempt::Response response;
    request.what = argv[1];
    request.argument = argc > 2 ? argv[2] : "";
    bool known = tryIt(request, response);
    std::printf("%s: %s\n", response.succeeded ? "succeeded" : "failed", response.report.c_str());
    return known ? 0 : 2;
  }
  ros::init(argc, argv, "burglar");
  ros::NodeHandle node("~");
  ros::ServiceServer server = node.advertiseService("try", tryIt);
  // Several at once, so that one which takes long holds up no other.
  ros::AsyncSpinner spinner(4);
  spinner.start();
  ros::waitForShutdown();
}
