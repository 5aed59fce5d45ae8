// Repeats what it hears, and recalls it when it is asked.
#include <parrot_rcl/node.hpp>

#include <chrono>
#include <exception>
#include <iostream>
#include <map>
#include <string>

#include <parrot_msgs/msg/phrase.h>
#include <parrot_msgs/srv/recall.h>
#include <std_msgs/msg/string.h>

using Phrase = PARROT_MESSAGE(parrot_msgs__msg__Phrase);
using Request = PARROT_MESSAGE(parrot_msgs__srv__Recall_Request);
using Response = PARROT_MESSAGE(parrot_msgs__srv__Recall_Response);
using String = PARROT_MESSAGE(std_msgs__msg__String);

namespace {

// Phrases, with how often each was heard.
using Memory = std::map<std::string, uint32_t>;

void repeat(const rcl_publisher_t* repeated, Memory& memory, const String& heard) {
  const std::string words(heard.data.data, heard.data.size);
  Phrase phrase;
  const auto now = std::chrono::system_clock::now().time_since_epoch();
  const auto seconds = std::chrono::duration_cast<std::chrono::seconds>(now);
  phrase.stamp.sec = static_cast<int32_t>(seconds.count());
  phrase.stamp.nanosec = static_cast<uint32_t>(std::chrono::nanoseconds(now - seconds).count());
  phrase.count = ++memory[words];
  parrot_rcl::assign(phrase.words, words);
  parrot_rcl::expect_ok(rcl_publish(repeated, &phrase, nullptr), "a phrase");
}

void recall(const Memory& memory, const Request& request, Response& response) {
  const std::string part(request.words.data, request.words.size);
  Memory found;
  for (const auto& [words, count] : memory) {
    if (words.find(part) != std::string::npos) {
      found[words] = count;
    }
  }
  parrot_msgs__msg__Phrase__Sequence__fini(&response.phrases);
  if (!parrot_msgs__msg__Phrase__Sequence__init(&response.phrases, found.size())) {
    throw std::bad_alloc();
  }
  auto* phrase = response.phrases.data;
  for (const auto& [words, count] : found) {
    parrot_rcl::assign(phrase->words, words);
    phrase->count = count;
    ++phrase;
  }
}

void run(int argc, char** argv) {
  parrot_rcl::Node node("parrot", argc, argv);
  Memory memory;
  const auto* repeated = node.advertise("repeated", ROSIDL_GET_MSG_TYPE_SUPPORT(parrot_msgs, msg, Phrase));
  node.subscribe<String>("heard", ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, String),
                         [repeated, &memory](const String& heard) { repeat(repeated, memory, heard); });
  node.serve<Request, Response>(
      "recall", ROSIDL_GET_SRV_TYPE_SUPPORT(parrot_msgs, srv, Recall),
      [&memory](const Request& request, Response& response) { recall(memory, request, response); });
  node.spin();
}

}  // namespace

int main(int argc, char** argv) {
  try {
    run(argc, argv);
  } catch (const std::exception& error) {
    std::cerr << error.what() << std::endl;
    return 1;
  }
  return 0;
}
