// Writes what it hears into a bag, and says how many messages that were.
#include <ros/ros.h>
#include <rosbag/bag.h>
#include <std_msgs/Int32.h>
#include <std_msgs/String.h>

int main(int argc, char** argv) {
  // Not the executable's name.
  ros::init(argc, argv, "bag_recorder", ros::init_options::AnonymousName);
  ros::NodeHandle own("~");
  rosbag::Bag bag(own.param<std::string>("file", "/tmp/recorded.bag"), rosbag::bagmode::Write);
  int count = 0;
  ros::Publisher counted = own.advertise<std_msgs::Int32>("count", 1, true);
  boost::function<void(const std_msgs::String::ConstPtr&)> hear = [&](const std_msgs::String::ConstPtr& text) {
    bag.write("/text", ros::Time::now(), *text);
    std_msgs::Int32 number;
    number.data = ++count;
    counted.publish(number);
  };
  ros::Subscriber text = own.subscribe<std_msgs::String>("text", 10, hear);
  ros::spin();
}
