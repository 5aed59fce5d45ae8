// Computes for so many milliseconds of a core at each call of /work, one call after the other.
#include <ros/ros.h>
#include <std_srvs/Empty.h>
#include <time.h>

#include <cmath>

namespace {

// Processor time of this thread: what others do on the same core is not counted.
double used() {
  timespec now = {};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return now.tv_sec + now.tv_nsec * 1e-9;
}

void compute(double seconds) {
  volatile double sum = 0;
  for (const double until = used() + seconds; used() < until && ros::ok();)
    for (int n = 1; n <= 1000; ++n) sum = sum + std::sqrt(n);
}

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "worker");
  ros::NodeHandle node, own("~");
  const double seconds = own.param("milliseconds", 10.0) / 1000;
  boost::function<bool(std_srvs::Empty::Request&, std_srvs::Empty::Response&)> answer = [seconds](auto&, auto&) {
    compute(seconds);
    return true;
  };
  auto work = node.advertiseService("work", answer);
  ros::spin();
}
