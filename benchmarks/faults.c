/* Stops or fails a process at its Nth write, fsync, truncate, rename or unlink below one folder. Preloaded by torture.py. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <limits.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

enum { COUNT, KILL, TEAR, FAIL_ONCE, FAIL_ON };

static char folder[PATH_MAX];
static long countdown_from, n_calls;
static int mode, error_number;

void faults_arm(const char *below, long at, int how, int number) {
  snprintf(folder, sizeof folder, "%s", below);
  countdown_from = at, mode = how, error_number = number, n_calls = 0;
}

long faults_count(void) { return n_calls; }

static int is_below(const char *path) { return folder[0] && strncmp(path, folder, strlen(folder)) == 0; }

static int is_ours(int fd) {
  char link[64], path[PATH_MAX];
  snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  ssize_t n = folder[0] ? readlink(link, path, sizeof path - 1) : -1;
  if (n < 0) return 0;
  path[n] = 0;
  return is_below(path);
}

/* 1: the call must fail; 2: half of it must happen, and then the end */
static int fate(int ours) {
  if (!ours) return 0;
  long now = __atomic_add_fetch(&n_calls, 1, __ATOMIC_SEQ_CST);
  if (now < countdown_from || mode == COUNT) return 0;
  if (now > countdown_from) return mode == FAIL_ON;
  if (mode == KILL) raise(SIGKILL);
  return mode == TEAR ? 2 : 1;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define GUARD(ours, half)          \
  switch (fate(ours)) {            \
    case 2: half; raise(SIGKILL);  \
    case 1: errno = error_number;  \
      return -1;                   \
  }

ssize_t write(int fd, const void *data, size_t n) {
  GUARD(is_ours(fd), REAL(write)(fd, data, n / 2));
  return REAL(write)(fd, data, n);
}
ssize_t pwrite(int fd, const void *data, size_t n, off_t at) {
  GUARD(is_ours(fd), REAL(pwrite)(fd, data, n / 2, at));
  return REAL(pwrite)(fd, data, n, at);
}
ssize_t pwrite64(int fd, const void *data, size_t n, off64_t at) {
  GUARD(is_ours(fd), REAL(pwrite64)(fd, data, n / 2, at));
  return REAL(pwrite64)(fd, data, n, at);
}
int fsync(int fd) {
  GUARD(is_ours(fd), (void)0);
  return REAL(fsync)(fd);
}
int fdatasync(int fd) {
  GUARD(is_ours(fd), (void)0);
  return REAL(fdatasync)(fd);
}
int ftruncate(int fd, off_t n) {
  GUARD(is_ours(fd), (void)0);
  return REAL(ftruncate)(fd, n);
}
int ftruncate64(int fd, off64_t n) {
  GUARD(is_ours(fd), (void)0);
  return REAL(ftruncate64)(fd, n);
}
int rename(const char *from, const char *to) {
  GUARD(is_below(from), (void)0);
  return REAL(rename)(from, to);
}
int unlink(const char *path) {
  GUARD(is_below(path), (void)0);
  return REAL(unlink)(path);
}
