#include <ros/ros.h>
int main() { return ros::no_such_function(); }
