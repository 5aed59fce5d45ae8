//! ROS 1: XML-RPC, Master, TCPROS and the bus made of them.
