// Taking as much as there is: processor time, memory, processes.
#include <fcntl.h>
#include <signal.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <thread>
#include <vector>

#include "tries.h"

namespace {

std::atomic<bool> burning{false};

// So many threads that never rest, until "rest".
Outcome burn(const std::string& threads) {
  burning = true;
  for (int i = std::stoi(threads); i > 0; --i)
    std::thread([] {
      volatile unsigned long sum = 0;
      while (burning) sum += 1;
    }).detach();
  return {true, threads + " threads"};
}

Outcome rest(const std::string&) {
  burning = false;
  return {true, "resting"};
}

// A fixed piece of work; how many microseconds it took.
Outcome work(const std::string& rounds) {
  auto begin = std::chrono::steady_clock::now();
  volatile unsigned long sum = 0;
  for (unsigned long i = std::stoul(rounds); i > 0; --i) sum += i;
  auto took = std::chrono::steady_clock::now() - begin;
  return {true, std::to_string(std::chrono::duration_cast<std::chrono::microseconds>(took).count())};
}

// So many megabytes, touched and kept.
Outcome take(const std::string& megabytes) {
  size_t size = std::stoul(megabytes) << 20;
  // Kept, lest the compiler sees that nobody needs it.
  static std::vector<char*> taken;
  char* memory = static_cast<char*>(malloc(size));
  if (!memory) return outcome(-1);
  std::memset(memory, 'x', size);
  taken.push_back(memory);
  return {true, megabytes + " MB taken"};
}

// Processes that make processes, as many as can be.
Outcome bomb(const std::string&) {
  pid_t first = fork();
  if (first < 0) return outcome(-1);
  if (first == 0)
    for (;;)
      if (fork() < 0) usleep(1000);
  return {true, "lit"};
}

// The program ends as it is told: "exit 3", "signal 11".
Outcome end(const std::string& how) {
  int number = std::stoi(how.substr(how.find(' ') + 1));
  std::thread([how, number] {
    usleep(50000);
    if (how[0] == 'e') _exit(number);
    kill(getpid(), number);
  }).detach();
  return {true, how};
}

// "PATH TEXT": leaves a text in a file.
Outcome leave(const std::string& argument) {
  size_t space = argument.find(' ');
  std::ofstream file(argument.substr(0, space));
  file << argument.substr(space + 1);
  return {static_cast<bool>(file.flush()), "written"};
}

// Whether the first bytes of a file can be read.
Outcome readSome(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  char bytes[4];
  return {static_cast<bool>(file.read(bytes, sizeof bytes)), path};
}

// What a variable of the environment holds.
Outcome environment(const std::string& name) {
  const char* value = getenv(name.c_str());
  return {value != nullptr, value ? value : ""};
}

// Bytes that a directory takes, until it takes no more.
Outcome fill(const std::string& directory) {
  int fd = open((directory + "/filled").c_str(), O_CREAT | O_WRONLY | O_CLOEXEC, 0600);
  if (fd < 0) return outcome(-1);
  static const std::vector<char> block(1 << 16, 'x');
  long total = 0, count;
  while ((count = write(fd, block.data(), block.size())) > 0) total += count;
  std::string why = std::strerror(errno);
  close(fd);
  return {true, std::to_string(total) + " " + why};
}

// Files that a directory takes, until it takes no more.
Outcome crowd(const std::string& directory) {
  long total = 0;
  for (int fd;; ++total) {
    fd = open((directory + "/one-of-many-" + std::to_string(total)).c_str(), O_CREAT | O_WRONLY | O_CLOEXEC, 0600);
    if (fd < 0) break;
    close(fd);
  }
  return {true, std::to_string(total) + " " + std::strerror(errno)};
}

// Prints so many megabytes in lines.
Outcome shout(const std::string& megabytes) {
  const std::string line(1023, 'x');
  for (size_t i = std::stoul(megabytes) << 10; i > 0; --i) std::puts(line.c_str());
  std::fflush(stdout);
  return {true, "shouted"};
}

// Answers after so many milliseconds.
Outcome waitFor(const std::string& milliseconds) {
  std::this_thread::sleep_for(std::chrono::milliseconds(std::stoi(milliseconds)));
  return {true, "waited"};
}

}  // namespace

const Tries& appetite() {
  static const Tries all{{"burn", burn}, {"rest", rest}, {"work", work},    {"take", take},
                         {"bomb", bomb}, {"end", end},   {"wait", waitFor},
                         {"write", leave}, {"read", readSome}, {"environment", environment},
                         {"fill", fill}, {"crowd", crowd}, {"shout", shout}};
  return all;
}
