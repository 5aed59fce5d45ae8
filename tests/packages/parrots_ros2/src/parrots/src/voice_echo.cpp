#include <parrots/voice.hpp>

namespace {

class Echo : public parrots::Voice {
public:
  std::string say(const std::string& heard) const override { return heard + ", " + heard; }
};

}  // namespace

PARROTS_REGISTER_VOICE(Echo)
