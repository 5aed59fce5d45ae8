#include <parrots/voice.hpp>

#include <cctype>

namespace {

class Loud : public parrots::Voice {
public:
  std::string say(const std::string& heard) const override {
    std::string said = heard;
    for (char& letter : said) {
      letter = static_cast<char>(std::toupper(static_cast<unsigned char>(letter)));
    }
    return said + "!";
  }
};

}  // namespace

PARROTS_REGISTER_VOICE(Loud)
