// For measuring bridges: echoes, adds, publishes as many messages as it is given credit for, and counts what it
// receives. With credit instead of a rate nothing is dropped and nothing is measured but the way of the messages.
#include <ros/ros.h>
#include <rospy_tutorials/AddTwoInts.h>
#include <sensor_msgs/Image.h>
#include <std_msgs/String.h>
#include <std_msgs/UInt32.h>

namespace {

bool add(rospy_tutorials::AddTwoInts::Request& request, rospy_tutorials::AddTwoInts::Response& response) {
  response.sum = request.a + request.b;
  return true;
}

// Publishes `message` on NAME as often as NAME_credit asks for.
template <class Message>
class Source {
 public:
  Source(ros::NodeHandle& node, const std::string& name, const Message& message) : message_(message) {
    out_ = node.advertise<Message>(name, 1000);
    credit_ = node.subscribe(name + "_credit", 1000, &Source::pay, this, ros::TransportHints().tcpNoDelay());
  }

 private:
  void pay(const std_msgs::UInt32& credit) {
    for (uint32_t n = 0; n < credit.data; ++n) out_.publish(message_);
  }

  Message message_;
  ros::Publisher out_;
  ros::Subscriber credit_;
};

// Counts what arrives on NAME; every `step` messages tells how many there were on NAME_count.
template <class Message>
class Sink {
 public:
  Sink(ros::NodeHandle& node, const std::string& name, uint32_t step) : step_(step) {
    count_out_ = node.advertise<std_msgs::UInt32>(name + "_count", 1000);
    in_ = node.subscribe(name, 1000, &Sink::take, this, ros::TransportHints().tcpNoDelay());
  }

 private:
  void take(const typename Message::ConstPtr&) {
    ++count_.data;
    if (count_.data % step_ == 0) count_out_.publish(count_);
  }

  uint32_t step_;
  std_msgs::UInt32 count_;
  ros::Publisher count_out_;
  ros::Subscriber in_;
};

// 640 x 480 RGB, every byte different from its neighbours.
sensor_msgs::Image picture() {
  sensor_msgs::Image image;
  image.header.frame_id = "camera";
  image.height = 480;
  image.width = 640;
  image.encoding = "rgb8";
  image.step = 3 * image.width;
  image.data.resize(image.height * image.step);
  uint32_t state = 1;
  for (auto& byte : image.data) {
    state = state * 1664525u + 1013904223u;
    byte = state >> 24;
  }
  return image;
}

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "meter");
  ros::NodeHandle node("~");
  std_msgs::String small;
  small.data = "a message of a usual size";
  Source<std_msgs::String> small_out(node, "small_out", small);
  Source<sensor_msgs::Image> image_out(node, "image_out", picture());
  Sink<std_msgs::String> small_in(node, "small_in", 16);
  Sink<sensor_msgs::Image> image_in(node, "image_in", 1);
  auto pong = node.advertise<std_msgs::String>("pong", 1000);
  auto ping = node.subscribe<std_msgs::String>(
      "ping", 1000, [&pong](const std_msgs::String::ConstPtr& message) { pong.publish(message); }, ros::VoidConstPtr(),
      ros::TransportHints().tcpNoDelay());
  auto adder = node.advertiseService("add", add);
  ros::spin();
}
