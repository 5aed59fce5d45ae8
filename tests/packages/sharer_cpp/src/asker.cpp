// Calls sharer for some seconds over one connection, as fast as it answers, and prints how many calls a second that were.
#include <ros/ros.h>
#include <sharer_cpp/Work.h>

int main(int argc, char** argv) {
  ros::init(argc, argv, "asker");
  ros::NodeHandle node, own("~");
  double seconds = own.param("seconds", 0.0), lasts = own.param("lasts", 5.0);
  // A client that keeps its connection is made after the service: it looks for it only once.
  ros::service::waitForService(node.resolveName("work"));
  auto client = node.serviceClient<sharer_cpp::Work>("work", true);
  sharer_cpp::Work work;
  work.request.who = "asker";
  work.request.seconds = seconds;
  client.call(work);
  const auto began = ros::WallTime::now();
  int calls = 0;
  while (ros::ok() && (ros::WallTime::now() - began).toSec() < lasts && client.call(work)) {
    ++calls;
  }
  if (calls == 0) {
    fprintf(stderr, "work was not answered\n");
    return 1;
  }
  printf("calls a second: %f\n", calls / (ros::WallTime::now() - began).toSec());
  fflush(stdout);
  ros::spin();
}
