// Ways out of a container, and into its neighbours. Each makes the real system call.
#include <arpa/inet.h>
#include <dirent.h>
#include <fcntl.h>
#include <linux/if_packet.h>
#include <net/ethernet.h>
#include <net/if.h>
#include <netdb.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/mount.h>
#include <sys/ptrace.h>
#include <sys/resource.h>
#include <sys/shm.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/sysmacros.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <fstream>
#include <sstream>

#include "tries.h"

Outcome outcome(long result) {
  if (result >= 0) return {true, "it worked"};
  return {false, std::strerror(errno)};
}

namespace {

// In a child, so that what happens to it does not happen to us.
Outcome apart(const std::function<long()>& call) {
  int ends[2];
  if (pipe(ends) != 0) return outcome(-1);
  pid_t child = fork();
  if (child == 0) {
    int error = call() >= 0 ? 0 : errno;
    if (write(ends[1], &error, sizeof error) < 0) _exit(1);
    _exit(0);
  }
  close(ends[1]);
  int error = ECHILD;
  bool told = read(ends[0], &error, sizeof error) == sizeof error;
  close(ends[0]);
  waitpid(child, nullptr, 0);
  if (!told) return {false, "the child was killed"};
  errno = error;
  return error == 0 ? Outcome{true, "it worked"} : outcome(-1);
}

long opened(const char* path, int flags) {
  int fd = open(path, flags | O_CLOEXEC, 0600);
  if (fd >= 0) close(fd);
  return fd;
}

long written(const std::string& path, const std::string& text) {
  int fd = open(path.c_str(), O_WRONLY | O_CLOEXEC);
  if (fd < 0) return -1;
  long count = write(fd, text.data(), text.size());
  int error = errno;
  close(fd);
  errno = error;
  return count;
}

// Whether a connection is accepted, or a datagram answered, within a second.
Outcome reached(const std::string& address, int type) {
  size_t colon = address.rfind(':');
  sockaddr_in to{};
  to.sin_family = AF_INET;
  to.sin_port = htons(std::stoi(address.substr(colon + 1)));
  if (inet_pton(AF_INET, address.substr(0, colon).c_str(), &to.sin_addr) != 1) return {false, "no address"};
  int fd = socket(AF_INET, type | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
  if (fd < 0) return outcome(-1);
  long result = connect(fd, reinterpret_cast<sockaddr*>(&to), sizeof to);
  if (result == 0 && type == SOCK_DGRAM) result = send(fd, "x", 1, 0);
  if (result < 0 && errno == EINPROGRESS) {
    pollfd waiting{fd, POLLOUT, 0};
    int error = ETIMEDOUT;
    socklen_t size = sizeof error;
    if (poll(&waiting, 1, 1000) == 1) getsockopt(fd, SOL_SOCKET, SO_ERROR, &error, &size);
    errno = error;
    result = error == 0 ? 0 : -1;
  }
  Outcome told = outcome(result);
  close(fd);
  return told;
}

// Whether a directory shows anything of the pids of others: only our own namespace's may be there.
Outcome foreignProcesses(const std::string& pid) {
  if (kill(std::stoi(pid), 0) == 0) return {true, "it can be signalled"};
  struct stat found;
  return outcome(stat(("/proc/" + pid + "/root").c_str(), &found));
}

Outcome unexpectedDevices(const std::string&) {
  std::string extra;
  DIR* directory = opendir("/dev");
  if (!directory) return outcome(-1);
  while (dirent* entry = readdir(directory)) {
    std::string name = entry->d_name;
    struct stat found;
    if (lstat(("/dev/" + name).c_str(), &found) != 0 || !(S_ISBLK(found.st_mode) || S_ISCHR(found.st_mode))) continue;
    if (!std::strstr(" null zero full random urandom tty ptmx ", (" " + name + " ").c_str())) extra += " " + name;
  }
  closedir(directory);
  if (extra.empty()) return {false, "only the harmless ones"};
  return {true, "there are" + extra};
}

Outcome otherInterfaces(const std::string&) {
  std::ifstream table("/proc/net/dev");
  std::string line, extra;
  while (std::getline(table, line)) {
    size_t colon = line.find(':');
    if (colon == std::string::npos) continue;
    std::string name = line.substr(line.find_first_not_of(' '), colon - line.find_first_not_of(' '));
    if (name != "lo") extra += " " + name;
  }
  return extra.empty() ? Outcome{false, "lo alone"} : Outcome{true, "there are" + extra};
}

Outcome hostMounts(const std::string& path) {
  struct stat found;
  if (stat(path.c_str(), &found) == 0) return {true, path + " is there"};
  return outcome(-1);
}

Outcome textInside(const std::string& argument) {
  // "PATH TEXT": whether the file holds the text.
  size_t space = argument.find(' ');
  std::ifstream file(argument.substr(0, space));
  std::stringstream text;
  text << file.rdbuf();
  if (!file) return {false, "it cannot be read"};
  bool found = text.str().find(argument.substr(space + 1)) != std::string::npos;
  return {found, found ? "it is there" : "it is not there"};
}

Outcome capabilities(const std::string&) {
  std::ifstream status("/proc/self/status");
  std::string line;
  while (std::getline(status, line))
    if (line.rfind("Cap", 0) == 0 && line.find_first_of("123456789abcdef", 7) != std::string::npos) return {true, line};
  return {false, "none"};
}

Outcome remount(const std::string&) {
  return apart([] { return mount(nullptr, "/", nullptr, MS_REMOUNT | MS_BIND, nullptr); });
}

Outcome mknodOf(mode_t kind, int major, int minor) {
  return apart([=] {
    unlink("/tmp/node");
    if (mknod("/tmp/node", kind | 0600, makedev(major, minor)) != 0) return -1L;
    return opened("/tmp/node", O_RDONLY);
  });
}

Outcome abstractSocket(const std::string& name) {
  sockaddr_un to{};
  to.sun_family = AF_UNIX;
  std::strncpy(to.sun_path + 1, name.c_str(), sizeof to.sun_path - 2);
  int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  Outcome told = outcome(connect(fd, reinterpret_cast<sockaddr*>(&to), offsetof(sockaddr_un, sun_path) + 1 + name.size()));
  close(fd);
  return told;
}

Outcome layerWrite(const std::string&) {
  // Whatever program this is, it lies in a layer.
  char self[4096];
  ssize_t length = readlink("/proc/self/exe", self, sizeof self - 1);
  if (length < 0) return outcome(-1);
  self[length] = 0;
  for (const char* path : {static_cast<const char*>(self), "/bin/sh", "/etc/passwd"}) {
    if (opened(path, O_WRONLY) >= 0) return {true, path};
    if (errno == ETXTBSY) return {true, std::string(path) + " is only busy"};
    if (chmod(path, 0777) == 0) return {true, std::string("mode of ") + path};
    if (unlink(path) == 0) return {true, std::string("unlinked ") + path};
  }
  for (const char* directory : {"/usr", "/etc", "/opt", "/lib", "/"}) {
    std::string path = std::string(directory) + "/burglar-was-here";
    if (opened(path.c_str(), O_CREAT | O_WRONLY) >= 0) return {true, path};
  }
  return outcome(-1);
}

Outcome coreDump(const std::string&) {
  rlimit limit{RLIM_INFINITY, RLIM_INFINITY};
  if (setrlimit(RLIMIT_CORE, &limit) == 0) return {true, "the limit was raised"};
  return outcome(-1);
}

Outcome killInit(const std::string&) {
  // The kernel takes the signal and drops it: init must live on.
  for (int signal : {SIGKILL, SIGSTOP, SIGTERM}) kill(1, signal);
  usleep(100000);
  return kill(1, 0) == 0 ? Outcome{false, "init lives"} : Outcome{true, "init is gone"};
}

Outcome cloneWith(unsigned long flags) {
  return apart([=]() -> long {
    long child = syscall(SYS_clone, flags | SIGCHLD, nullptr, nullptr, nullptr, nullptr);
    if (child == 0) _exit(0);
    return child;
  });
}

Tries all() {
  Tries tries;
  auto call = [&tries](const char* name, std::function<long()> what) {
    tries[name] = [what](const std::string&) { return apart(what); };
  };
  // mounts and roots
  call("mount-tmpfs", [] { return mount("none", "/tmp", "tmpfs", 0, nullptr); });
  call("mount-proc", [] { return mount("proc", "/tmp", "proc", 0, nullptr); });
  call("mount-bind", [] { return mount("/proc", "/tmp", nullptr, MS_BIND, nullptr); });
  call("umount-proc", [] { return umount2("/proc", MNT_DETACH); });
  call("open-tree", [] { return syscall(428, AT_FDCWD, "/", 1); });
  call("fsopen", [] { return syscall(430, "tmpfs", 0); });
  call("mount-setattr", [] { return syscall(442, AT_FDCWD, "/", 0, nullptr, 0); });
  call("chroot", [] { return chroot("/tmp"); });
  call("pivot-root", [] { return syscall(SYS_pivot_root, "/tmp", "/tmp"); });
  tries["remount-writable"] = remount;
  // namespaces
  call("unshare-user", [] { return unshare(CLONE_NEWUSER); });
  call("unshare-mount", [] { return unshare(CLONE_NEWNS); });
  call("unshare-net", [] { return unshare(CLONE_NEWNET); });
  call("unshare-everything", [] { return unshare(CLONE_NEWUSER | CLONE_NEWNS | CLONE_NEWNET | CLONE_NEWPID | CLONE_NEWIPC); });
  tries["clone-user"] = [](const std::string&) { return cloneWith(CLONE_NEWUSER); };
  tries["clone-user-and-mount"] = [](const std::string&) { return cloneWith(CLONE_NEWUSER | CLONE_NEWNS); };
  call("clone3", [] { return syscall(435, nullptr, 0) < 0 && errno == ENOSYS ? -1L : 0L; });
  call("setns", [] {
    int fd = open("/proc/1/ns/mnt", O_RDONLY);
    return fd < 0 ? -1L : static_cast<long>(setns(fd, 0));
  });
  // other processes
  call("ptrace-init", [] { return ptrace(PTRACE_ATTACH, 1, nullptr, nullptr); });
  call("ptrace-child", [] { return ptrace(PTRACE_TRACEME, 0, nullptr, nullptr); });
  call("read-memory-of-init", [] {
    char byte;
    iovec here{&byte, 1}, there{reinterpret_cast<void*>(0x400000), 1};
    return static_cast<long>(process_vm_readv(1, &here, 1, &there, 1, 0));
  });
  call("open-memory-of-init", [] { return opened("/proc/1/mem", O_RDWR); });
  call("descriptors-of-init", [] {
    // How many there are may be seen, what they are may not.
    char target[64];
    return static_cast<long>(readlink("/proc/1/fd/0", target, sizeof target));
  });
  call("root-of-init", [] { return opened("/proc/1/root", O_RDONLY); });
  call("pidfd-getfd", [] {
    long pid = syscall(434, 1, 0);
    return pid < 0 ? -1L : syscall(438, pid, 0, 0);
  });
  tries["kill-init"] = killInit;
  tries["foreign-process"] = foreignProcesses;
  // sockets
  call("raw-socket", [] { return static_cast<long>(socket(AF_INET, SOCK_RAW, IPPROTO_ICMP)); });
  call("raw-socket-6", [] { return static_cast<long>(socket(AF_INET6, SOCK_RAW, IPPROTO_ICMPV6)); });
  call("packet-socket", [] { return static_cast<long>(socket(AF_PACKET, SOCK_RAW, htons(ETH_P_ALL))); });
  call("packet-datagram", [] { return static_cast<long>(socket(AF_PACKET, SOCK_DGRAM, htons(ETH_P_ALL))); });
  call("crypto-socket", [] { return static_cast<long>(socket(AF_ALG, SOCK_SEQPACKET, 0)); });
  call("vsock", [] { return static_cast<long>(socket(AF_VSOCK, SOCK_STREAM, 0)); });
  call("bluetooth-socket", [] { return static_cast<long>(socket(AF_BLUETOOTH, SOCK_RAW, 1)); });
  call("rename-interface", [] {
    int fd = socket(AF_INET, SOCK_DGRAM, 0);
    ifreq request{};
    std::strcpy(request.ifr_name, "lo");
    request.ifr_flags = 0;
    return static_cast<long>(ioctl(fd, SIOCSIFFLAGS, &request));
  });
  tries["abstract-socket"] = abstractSocket;
  tries["connect"] = [](const std::string& address) { return reached(address, SOCK_STREAM); };
  tries["datagram"] = [](const std::string& address) { return reached(address, SOCK_DGRAM); };
  tries["other-interfaces"] = otherInterfaces;
  // parts of the kernel
  call("add-key", [] { return syscall(SYS_add_key, "user", "x", "y", 1, -4); });
  call("keyctl", [] { return syscall(SYS_keyctl, 0, -3, 1); });
  call("request-key", [] { return syscall(SYS_request_key, "user", "x", nullptr, 0); });
  call("bpf", [] {
    char attributes[128] = {2, 0, 0, 0, 4, 0, 0, 0, 4, 0, 0, 0, 1, 0, 0, 0};
    return syscall(SYS_bpf, 0, attributes, sizeof attributes);
  });
  call("perf", [] {
    char attributes[128] = {1, 0, 0, 0, 112, 0, 0, 0};
    return syscall(SYS_perf_event_open, attributes, 0, -1, -1, 0);
  });
  call("io-uring", [] {
    char parameters[120] = {};
    return syscall(425, 4, parameters);
  });
  call("userfaultfd", [] { return syscall(SYS_userfaultfd, 1); });
  call("open-by-handle", [] {
    char handle[24] = {8, 0, 0, 0, 1};
    return syscall(SYS_open_by_handle_at, AT_FDCWD, handle, O_RDONLY);
  });
  call("load-module", [] { return syscall(SYS_init_module, "", 0, ""); });
  call("kexec", [] { return syscall(SYS_kexec_load, 0, 0, nullptr, 0); });
  call("reboot", [] { return syscall(SYS_reboot, 0xfee1dead, 672274793, 0, nullptr); });
  call("swapoff", [] { return syscall(SYS_swapoff, "/swap"); });
  call("set-clock", [] {
    timeval now;
    gettimeofday(&now, nullptr);
    return static_cast<long>(settimeofday(&now, nullptr));
  });
  call("set-hostname", [] { return static_cast<long>(sethostname("burgled", 7)); });
  call("kernel-log", [] {
    char text[64];
    return syscall(SYS_syslog, 3, text, sizeof text);
  });
  call("become-another-user", [] { return static_cast<long>(setuid(1)); });
  call("real-time", [] {
    sched_param parameters{};
    parameters.sched_priority = 50;
    return static_cast<long>(sched_setscheduler(0, SCHED_FIFO, &parameters));
  });
  call("nicer", [] { return static_cast<long>(setpriority(PRIO_PROCESS, 0, -20)); });
  tries["capabilities"] = capabilities;
  // /proc and /sys
  call("sysrq", [] { return written("/proc/sysrq-trigger", "h"); });
  call("core-pattern", [] { return written("/proc/sys/kernel/core_pattern", "|/tmp/x"); });
  call("modprobe-path", [] { return written("/proc/sys/kernel/modprobe", "/tmp/x"); });
  call("uid-map", [] { return written("/proc/self/uid_map", "0 0 1"); });
  call("binfmt", [] { return written("/proc/sys/fs/binfmt_misc/register", ":x:M::x::/tmp/x:"); });
  call("oom-score", [] { return written("/proc/self/oom_score_adj", "-1000"); });
  call("kernel-memory", [] {
    int fd = open("/proc/kcore", O_RDONLY);
    char byte;
    return fd < 0 ? -1L : static_cast<long>(read(fd, &byte, 1)) == 1 ? 0L : (errno = ENODATA, -1L);
  });
  call("sysfs", [] { return opened("/sys/kernel", O_RDONLY | O_DIRECTORY); });
  call("cgroup", [] { return written("/sys/fs/cgroup/memory.max", "max"); });
  call("cgroup-leave", [] { return written("/sys/fs/cgroup/cgroup.procs", "1"); });
  tries["core-dump"] = coreDump;
  // devices
  tries["disk-node"] = [](const std::string&) { return mknodOf(S_IFBLK, 259, 0); };
  tries["memory-node"] = [](const std::string&) { return mknodOf(S_IFCHR, 1, 1); };
  tries["kvm-node"] = [](const std::string&) { return mknodOf(S_IFCHR, 10, 232); };
  tries["unexpected-devices"] = unexpectedDevices;
  // files
  tries["write-a-layer"] = layerWrite;
  tries["host-path"] = hostMounts;
  tries["text-in-file"] = textInside;
  call("set-uid-program", [] {
    // Made by us it may be, but it must give nothing: no_new_privs and nosuid.
    if (opened("/tmp/suid", O_CREAT | O_WRONLY) < 0) return -1L;
    if (chown("/tmp/suid", 1, 1) == 0) return 0L;
    return -1L;
  });
  tries["host-shared-memory"] = [](const std::string& key) { return outcome(shmget(std::stoi(key), 1, 0)); };
  return tries;
}

}  // namespace

const Tries& attempts() {
  static const Tries tries = all();
  return tries;
}
