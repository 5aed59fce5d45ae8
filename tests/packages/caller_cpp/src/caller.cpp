// Calls what others serve. ~once, ~kept and ~measure each make one call when asked; ~told says when `awaited` is there.
#include <caller_cpp/Measure.h>
#include <ros/ros.h>
#include <std_msgs/String.h>
#include <std_srvs/Trigger.h>

#include <cmath>
#include <string>
#include <thread>

using std_srvs::Trigger;

class Caller {
public:
  Caller() : private_("~") {
    told_ = private_.advertise<std_msgs::String>("told", 10, true);
    once_ = private_.advertiseService("once", &Caller::once, this);
    keeps_ = private_.advertiseService("kept", &Caller::keeps, this);
    measures_ = private_.advertiseService("measure", &Caller::measures, this);
    waiting_ = std::thread([this] {
      if (!ros::service::waitForService("awaited")) return;
      std_msgs::String said;
      said.data = ros::service::exists("awaited", false) ? "awaited is there" : "awaited is gone again";
      told_.publish(said);
    });
  }
  ~Caller() { waiting_.join(); }

private:
  bool once(Trigger::Request&, Trigger::Response& said) {
    Trigger secret;
    said.success = ros::service::call("secret", secret);
    said.message = said.success ? secret.response.message : "it failed";
    return true;
  }

  // Over the same connection as before, if that is still good.
  bool keeps(Trigger::Request&, Trigger::Response& said) {
    const bool fresh = !kept_ || !kept_.isValid();
    if (fresh) kept_ = node_.serviceClient<Trigger>("secret", true);
    Trigger secret;
    said.success = kept_.call(secret);
    said.message = std::string(fresh ? "newly " : "still ") + (said.success ? secret.response.message : "it failed");
    return true;
  }

  // Sends three megabytes and a stamp; is given them back, and what time it was.
  bool measures(Trigger::Request&, Trigger::Response& said) {
    caller_cpp::Measure measure;
    measure.request.header.stamp = ros::Time::now();
    for (uint32_t i = 0; i < 3000000; ++i) measure.request.data.push_back(i % 251);
    if (!ros::service::call("scale", measure)) {
      said.message = "it failed";
      return true;
    }
    const auto& response = measure.response;
    if (response.data != measure.request.data) said.message += "other data; ";
    if (response.header.stamp != measure.request.header.stamp) said.message += "another stamp; ";
    if (response.moments.size() != 2) said.message += "not two moments; ";
    for (const auto& moment : response.moments) {
      const double age = (ros::Time::now() - moment).toSec();
      if (std::abs(age) > 60.0) said.message += std::to_string(age) + " s old; ";
    }
    said.success = said.message.empty();
    return true;
  }

  ros::NodeHandle node_, private_;
  ros::Publisher told_;
  ros::ServiceServer once_, keeps_, measures_;
  ros::ServiceClient kept_;
  std::thread waiting_;
};

int main(int argc, char** argv) {
  ros::init(argc, argv, "caller");
  Caller caller;
  ros::spin();
}
