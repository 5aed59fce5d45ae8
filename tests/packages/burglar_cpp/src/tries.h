#pragma once
#include <functional>
#include <map>
#include <string>

struct Outcome {
  bool succeeded;
  std::string report;
};

using Try = std::function<Outcome(const std::string& argument)>;
using Tries = std::map<std::string, Try>;

// What no servant may achieve.
const Tries& attempts();
// What every servant may do, within its limits.
const Tries& appetite();

// From a system call's result, told with errno.
Outcome outcome(long result);
