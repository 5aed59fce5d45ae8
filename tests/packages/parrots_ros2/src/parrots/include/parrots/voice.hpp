// What a library has to have that a cage can load.
#pragma once

#include <string>

namespace parrots {

class Voice {
public:
  virtual ~Voice() = default;
  virtual std::string say(const std::string& heard) const = 0;
};

using MakeVoice = Voice* (*)();

}  // namespace parrots

#define PARROTS_REGISTER_VOICE(CLASS) \
  extern "C" parrots::Voice* make_voice() { return new CLASS; }
