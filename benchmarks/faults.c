/* Stops or fails a process at its Nth write, fsync, truncate, rename or unlink below one folder. Preloaded by torture.py.
 *
 * It may keep a shadow of the folder beside: what a disk holds that loses everything but what was synced. There, a file has the
 * content that it had when it was synced last; names change at once. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

enum { COUNT, KILL, TEAR, FAIL_ONCE, FAIL_ON };

static char folder[PATH_MAX], shadow[PATH_MAX];
static long countdown_from, n_calls;
static int mode, error_number;

void faults_arm(const char *below, long at, int how, int number) {
  snprintf(folder, sizeof folder, "%s", below);
  countdown_from = at, mode = how, error_number = number, n_calls = 0;
}

void faults_shadow(const char *to) { snprintf(shadow, sizeof shadow, "%s", to); }

long faults_count(void) { return n_calls; }

static int is_below(const char *path) { return folder[0] && strncmp(path, folder, strlen(folder)) == 0; }

static int path_of(int fd, char *path) {
  char link[64];
  snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  ssize_t n = folder[0] ? readlink(link, path, PATH_MAX - 1) : -1;
  if (n < 0) return 0;
  path[n] = 0;
  return is_below(path);
}

static int is_ours(int fd) {
  char path[PATH_MAX];
  return path_of(fd, path);
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
/* The path in the shadow, whose folders are made. */
static const char *in_shadow(const char *path, char *to) {
  snprintf(to, PATH_MAX, "%.2000s%.2000s", shadow, path + strlen(folder));
  for (char *slash = strchr(to + 1, '/'); slash; slash = strchr(slash + 1, '/')) {
    *slash = 0, mkdir(to, 0700), *slash = '/';
  }
  return to;
}

static int synced(int fd, int result) {
  char path[PATH_MAX], to[PATH_MAX], data[65536];
  struct stat found;
  if (result || !shadow[0] || !path_of(fd, path) || fstat(fd, &found) || !S_ISREG(found.st_mode) || !found.st_nlink) return result;
  int from = open(path, O_RDONLY), copy = open(in_shadow(path, to), O_WRONLY | O_CREAT | O_TRUNC, 0600);
  for (ssize_t n; from >= 0 && copy >= 0 && (n = read(from, data, sizeof data)) > 0;) {
    if (REAL(write)(copy, data, n) != n) break;
  }
  close(from), close(copy);
  return result;
}

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
  return synced(fd, REAL(fsync)(fd));
}
int fdatasync(int fd) {
  GUARD(is_ours(fd), (void)0);
  return synced(fd, REAL(fdatasync)(fd));
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
  char old[PATH_MAX], new[PATH_MAX];
  if (shadow[0] && is_below(from)) REAL(rename)(in_shadow(from, old), in_shadow(to, new));
  return REAL(rename)(from, to);
}
int unlink(const char *path) {
  GUARD(is_below(path), (void)0);
  char gone[PATH_MAX];
  if (shadow[0] && is_below(path)) REAL(unlink)(in_shadow(path, gone));
  return REAL(unlink)(path);
}
