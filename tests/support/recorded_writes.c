/* Preloaded into a program: records what it writes below a folder, in order, so that a test can cut it at any point.
 *
 *   RECORD_FOLDER=/store RECORD_LOG=/log LD_PRELOAD=recorded_writes.so program
 *
 * Each record: operation, offset, length and path as one line, then `length` bytes.
 *   c PATH (made or emptied)  w (write)  t (cut to offset)  s (fsync of a file)  d (fsync of a folder)  r (rename)  u (unlink)
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

static int record_fd = -1;
static char folder[PATH_MAX];
static size_t folder_length;

__attribute__((constructor)) static void begin(void) {
    const char *wanted = getenv("RECORD_FOLDER"), *log = getenv("RECORD_LOG");
    if (!wanted || !log) return;
    folder_length = (size_t)snprintf(folder, sizeof folder, "%s", wanted);
    record_fd = (int)syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
}

static int is_ours(const char *path) { return record_fd >= 0 && strncmp(path, folder, folder_length) == 0; }

static void record(char operation, long long offset, const char *path, const void *data, size_t length) {
    char line[PATH_MAX + 64];
    int size = snprintf(line, sizeof line, "%c %lld %zu %s\n", operation, offset, length, path);
    struct iovec parts[2] = {{line, (size_t)size}, {(void *)data, length}};
    syscall(SYS_writev, record_fd, parts, length ? 2 : 1);
}

static int path_of(int fd, char *path) {
    char name[64];
    snprintf(name, sizeof name, "/proc/self/fd/%d", fd);
    ssize_t size = syscall(SYS_readlinkat, AT_FDCWD, name, path, PATH_MAX - 1);
    if (size < 0) return 0;
    path[size] = 0;
    return is_ours(path);
}

#define REAL(name) ({ static __typeof__(&name) real; if (!real) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name); real; })

static int opened(const char *path, int flags, mode_t mode) {
    char whole[PATH_MAX];
    struct stat found;
    int was_there = stat(path, &found) == 0;
    int fd = (int)syscall(SYS_openat, AT_FDCWD, path, flags, mode);
    if (fd >= 0 && ((flags & O_TRUNC) || ((flags & O_CREAT) && !was_there)) && path_of(fd, whole)) record('c', 0, whole, NULL, 0);
    return fd;
}

#define OPEN(name) int name(const char *path, int flags, ...) { \
    mode_t mode = 0; \
    if (flags & O_CREAT) { va_list rest; va_start(rest, flags); mode = va_arg(rest, mode_t); va_end(rest); } \
    return opened(path, flags, mode); }
OPEN(open)
OPEN(open64)

ssize_t pwrite64(int fd, const void *data, size_t length, off64_t offset) {
    char path[PATH_MAX];
    ssize_t done = syscall(SYS_pwrite64, fd, data, length, offset);
    if (done > 0 && path_of(fd, path)) record('w', offset, path, data, (size_t)done);
    return done;
}
ssize_t pwrite(int fd, const void *data, size_t length, off_t offset) { return pwrite64(fd, data, length, offset); }

ssize_t write(int fd, const void *data, size_t length) {
    char path[PATH_MAX];
    ssize_t done = syscall(SYS_write, fd, data, length);
    if (done > 0 && path_of(fd, path)) {
        off_t end = lseek(fd, 0, SEEK_CUR);
        record('w', end - done, path, data, (size_t)done);
    }
    return done;
}

static void synced(int fd) {
    char path[PATH_MAX];
    struct stat found;
    if (path_of(fd, path) && fstat(fd, &found) == 0) record(S_ISDIR(found.st_mode) ? 'd' : 's', 0, path, NULL, 0);
}
int fsync(int fd) { int done = (int)syscall(SYS_fsync, fd); if (!done) synced(fd); return done; }
int fdatasync(int fd) { int done = (int)syscall(SYS_fdatasync, fd); if (!done) synced(fd); return done; }

int ftruncate64(int fd, off64_t size) {
    char path[PATH_MAX];
    int done = (int)syscall(SYS_ftruncate, fd, size);
    if (!done && path_of(fd, path)) record('t', size, path, NULL, 0);
    return done;
}
int ftruncate(int fd, off_t size) { return ftruncate64(fd, size); }

int rename(const char *from, const char *to) {
    int done = REAL(rename)(from, to);
    if (!done && is_ours(from)) record('r', 0, from, to, strlen(to));
    return done;
}
int unlink(const char *path) {
    int done = REAL(unlink)(path);
    if (!done && is_ours(path)) record('u', 0, path, NULL, 0);
    return done;
}
