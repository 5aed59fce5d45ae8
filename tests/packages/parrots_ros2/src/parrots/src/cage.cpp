// Lets a bird be heard whose voice is in a library: the one that the parameter `voice` names among those that packages have registered.
#include <parrot_rcl/node.hpp>

#include <dlfcn.h>

#include <exception>
#include <iostream>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>

#include <ament_index_cpp/get_resource.hpp>
#include <parrots/voice.hpp>
#include <std_msgs/msg/string.h>

using String = PARROT_MESSAGE(std_msgs__msg__String);

namespace {

// The path of the library that has a voice.
std::string find_library(const std::string& voice) {
  std::string registered;
  std::string prefix;
  if (!ament_index_cpp::get_resource("parrot_voices", "parrots", registered, &prefix)) {
    throw std::runtime_error("no voices are registered");
  }
  std::istringstream lines(registered);
  for (std::string line; std::getline(lines, line);) {
    const auto end = line.find(';');
    if (line.substr(0, end) == voice && end != std::string::npos) {
      return prefix + "/" + line.substr(end + 1);
    }
  }
  throw std::runtime_error("no voice is called " + voice);
}

// Its library stays loaded.
std::unique_ptr<parrots::Voice> load_voice(const std::string& path) {
  void* library = dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
  void* symbol = library == nullptr ? nullptr : dlsym(library, "make_voice");
  if (symbol == nullptr) {
    throw std::runtime_error(dlerror());
  }
  return std::unique_ptr<parrots::Voice>(reinterpret_cast<parrots::MakeVoice>(symbol)());
}

void run(int argc, char** argv) {
  parrot_rcl::Node node("cage", argc, argv);
  const auto voice = load_voice(find_library(node.parameter("voice", "echo")));
  const auto* type = ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, String);
  const auto* sung = node.advertise("sung", type);
  node.subscribe<String>("heard", type, [sung, &voice](const String& heard) {
    String answer;
    parrot_rcl::assign(answer.data, voice->say(std::string(heard.data.data, heard.data.size)));
    parrot_rcl::expect_ok(rcl_publish(sung, &answer, nullptr), "a song");
  });
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
