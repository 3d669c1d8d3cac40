// A storage that fails, between a process and the kernel (LD_PRELOAD): the n-th call on files below one folder fails, is cut short, or is the
// last one. Nothing else is touched. `storage_arm` says which; `storage_calls` counts.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

enum { COUNT, FAIL_ONCE, FAIL_ON, SHORT, TORN, CRASH, CRASH_TORN };

static char under[4096];
static int armed_at, mode, error_number;
static int calls;
static int torn;

void storage_arm(const char *folder, int at, int how, int error) {
    snprintf(under, sizeof under, "%s", folder);
    armed_at = at, mode = how, error_number = error, calls = 0, torn = 0;
}
int storage_calls(void) { return calls; }

static int below(const char *path) {
    char real[4096];
    if (!under[0] || !path) return 0;
    if (path[0] != '/') {
        if (!getcwd(real, sizeof real)) return 0;
        return !strncmp(real, under, strlen(under));
    }
    return !strncmp(path, under, strlen(under));
}
static int below_handle(int handle) {
    char name[64], path[4096];
    if (!under[0]) return 0;
    snprintf(name, sizeof name, "/proc/self/fd/%d", handle);
    ssize_t n = readlink(name, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return !strncmp(path, under, strlen(under));
}
// Whether this call is to fail with `errno`; a full disk still removes, cuts and renames.
static int fails(int needs_room) {
    int n = __sync_add_and_fetch(&calls, 1);
    if (torn) { errno = error_number; return needs_room || error_number != ENOSPC; }
    if (n == armed_at && (mode == CRASH || (mode == CRASH_TORN && !needs_room))) _exit(137);
    int hit = (mode == FAIL_ONCE && n == armed_at) || (mode == FAIL_ON && n >= armed_at);
    if (!hit || (error_number == ENOSPC && !needs_room)) return 0;
    errno = error_number;
    return 1;
}

#define REAL(type, name, ...) static type (*real)(__VA_ARGS__); if (!real) real = dlsym(RTLD_NEXT, #name)

ssize_t write(int handle, const void *data, size_t size) {
    REAL(ssize_t, write, int, const void *, size_t);
    if (!below_handle(handle)) return real(handle, data, size);
    if (fails(1)) return -1;
    if (calls == armed_at && size > 1) {
        if (mode == SHORT) return real(handle, data, size / 2);
        if (mode == TORN) { torn = 1; return real(handle, data, size / 2); }
        if (mode == CRASH_TORN) { ssize_t done = real(handle, data, size / 2); (void)done; _exit(137); }
    } else if (calls == armed_at && mode == CRASH_TORN) _exit(137);
    return real(handle, data, size);
}
int fsync(int handle) {
    REAL(int, fsync, int);
    return below_handle(handle) && fails(1) ? -1 : real(handle);
}
int ftruncate(int handle, off_t size) {
    REAL(int, ftruncate, int, off_t);
    return below_handle(handle) && fails(0) ? -1 : real(handle, size);
}
int ftruncate64(int handle, off_t size) {
    REAL(int, ftruncate64, int, off_t);
    return below_handle(handle) && fails(0) ? -1 : real(handle, size);
}
int rename(const char *from, const char *to) {
    REAL(int, rename, const char *, const char *);
    return below(to) && fails(0) ? -1 : real(from, to);
}
int link(const char *from, const char *to) {
    REAL(int, link, const char *, const char *);
    return below(to) && fails(1) ? -1 : real(from, to);
}
int linkat(int a, const char *from, int b, const char *to, int flags) {
    REAL(int, linkat, int, const char *, int, const char *, int);
    return below(to) && fails(1) ? -1 : real(a, from, b, to, flags);
}
int unlink(const char *path) {
    REAL(int, unlink, const char *);
    return below(path) && fails(0) ? -1 : real(path);
}
int mkdir(const char *path, mode_t rights) {
    REAL(int, mkdir, const char *, mode_t);
    return below(path) && fails(1) ? -1 : real(path, rights);
}
#define OPEN(name)                                                                 \
    int name(const char *path, int flags, ...) {                                   \
        REAL(int, name, const char *, int, ...);                                   \
        va_list more;                                                              \
        va_start(more, flags);                                                     \
        mode_t rights = va_arg(more, mode_t);                                      \
        va_end(more);                                                              \
        return (flags & O_CREAT) && below(path) && fails(1) ? -1 : real(path, flags, rights); \
    }
OPEN(open)
OPEN(open64)
