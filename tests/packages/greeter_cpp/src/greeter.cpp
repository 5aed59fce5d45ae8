// Greets whoever is named on ~name. The word comes from ~word, the style from a YAML document in ~style,
// so that a library which is no ROS package (yaml-cpp) has to be found too.
#include <greeter_cpp/Count.h>
#include <greeter_cpp/Greeting.h>
#include <ros/ros.h>
#include <std_msgs/String.h>
#include <yaml-cpp/yaml.h>

class Greeter {
public:
  Greeter() : private_("~") {
    private_.param<std::string>("word", word_, "hello");
    std::string style;
    private_.param<std::string>("style", style, "{name: plain}");
    style_ = YAML::Load(style)["name"].as<std::string>();
    greetings_ = private_.advertise<greeter_cpp::Greeting>("greeting", 10, true);
    names_ = private_.subscribe("name", 10, &Greeter::greet, this);
    counter_ = private_.advertiseService("count", &Greeter::count, this);
  }

private:
  void greet(const std_msgs::String& name) {
    greeter_cpp::Greeting greeting;
    greeting.header.stamp = ros::Time::now();
    greeting.text = word_ + " " + name.data;
    greeting.count = ++count_;
    greetings_.publish(greeting);
  }

  bool count(greeter_cpp::Count::Request& request, greeter_cpp::Count::Response& response) {
    response.count = count_;
    response.style = style_;
    if (request.reset) count_ = 0;
    return true;
  }

  ros::NodeHandle private_;
  ros::Publisher greetings_;
  ros::Subscriber names_;
  ros::ServiceServer counter_;
  std::string word_, style_;
  uint32_t count_ = 0;
};

int main(int argc, char** argv) {
  ros::init(argc, argv, "greeter");
  Greeter greeter;
  ros::spin();
}
