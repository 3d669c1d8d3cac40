// A storage that fails, between a process and the kernel (LD_PRELOAD): the n-th call on files below one folder fails, is cut short, or is the
// last one. Nothing else is touched. `storage_arm` says which; `storage_calls` counts. `storage_journal` writes down what the calls did, with
// what each fsync made durable: power_cut.py makes of it what a power cut leaves.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
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

static int journal = -1;
static pthread_mutex_t order = PTHREAD_MUTEX_INITIALIZER;

void storage_journal(const char *path) { journal = path[0] ? open(path, O_CREAT | O_WRONLY | O_TRUNC, 0600) : -1; }

static void absolute(const char *path, char *out) {
    char here[PATH_MAX];
    if (path[0] == '/' || !getcwd(here, sizeof here)) snprintf(out, PATH_MAX, "%s", path);
    else snprintf(out, 2 * PATH_MAX, "%s/%s", here, path);
}
// One entry: what was done, to which inode, of what size; one or two paths; the content that an fsync made durable.
static void note(char what, int handle, const char *first, const char *second) {
    struct { char what; char pad[7]; unsigned long long inode, size; unsigned first, second, content; unsigned pad2; } head = {0};
    char one[2 * PATH_MAX] = "", two[2 * PATH_MAX] = "", name[64];
    char *content = NULL;
    struct stat facts;
    if (journal < 0) return;
    head.what = what;
    if (handle >= 0 && !fstat(handle, &facts)) head.inode = facts.st_ino, head.size = facts.st_size;
    if (first) absolute(first, one);
    if (second) absolute(second, two);
    if (what == 'S' && S_ISDIR(facts.st_mode)) {
        head.what = 'D';
        snprintf(name, sizeof name, "/proc/self/fd/%d", handle);
        ssize_t n = readlink(name, one, PATH_MAX - 1);
        one[n < 0 ? 0 : n] = 0;
    } else if (what == 'S') {
        snprintf(name, sizeof name, "/proc/self/fd/%d", handle);
        int again = open(name, O_RDONLY);  // the handle may be for writing only
        content = malloc(head.size + 1);
        ssize_t n = pread(again, content, head.size, 0);
        head.content = n < 0 ? 0 : n;
        close(again);
    }
    head.first = strlen(one), head.second = strlen(two);
    static ssize_t (*put)(int, const void *, size_t);
    if (!put) put = dlsym(RTLD_NEXT, "write");
    ssize_t done = put(journal, &head, sizeof head) + put(journal, one, head.first) + put(journal, two, head.second);
    for (unsigned at = 0; at < head.content && done >= 0;) at += (done = put(journal, content + at, head.content - at));
    free(content);
}
// The call, and its entry behind it, with no other call between them.
#define NOTED(type, call, what, handle, first, second)            \
    pthread_mutex_lock(&order);                                   \
    type result = call;                                           \
    int saved = errno;                                            \
    if (result >= 0) note(what, handle, first, second);           \
    errno = saved;                                                \
    pthread_mutex_unlock(&order);                                 \
    return result

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
    NOTED(ssize_t, real(handle, data, size), 'W', handle, NULL, NULL);
}
int fsync(int handle) {
    REAL(int, fsync, int);
    if (!below_handle(handle)) return real(handle);
    if (fails(1)) return -1;
    NOTED(int, real(handle), 'S', handle, NULL, NULL);
}
int ftruncate(int handle, off_t size) {
    REAL(int, ftruncate, int, off_t);
    if (!below_handle(handle)) return real(handle, size);
    if (fails(0)) return -1;
    NOTED(int, real(handle, size), 'T', handle, NULL, NULL);
}
int ftruncate64(int handle, off_t size) {
    REAL(int, ftruncate64, int, off_t);
    if (!below_handle(handle)) return real(handle, size);
    if (fails(0)) return -1;
    NOTED(int, real(handle, size), 'T', handle, NULL, NULL);
}
int rename(const char *from, const char *to) {
    REAL(int, rename, const char *, const char *);
    if (!below(to)) return real(from, to);
    if (fails(0)) return -1;
    NOTED(int, real(from, to), 'R', -1, from, to);
}
int link(const char *from, const char *to) {
    REAL(int, link, const char *, const char *);
    if (!below(to)) return real(from, to);
    if (fails(1)) return -1;
    NOTED(int, real(from, to), 'L', -1, from, to);
}
int linkat(int a, const char *from, int b, const char *to, int flags) {
    REAL(int, linkat, int, const char *, int, const char *, int);
    if (!below(to)) return real(a, from, b, to, flags);
    if (fails(1)) return -1;
    NOTED(int, real(a, from, b, to, flags), 'L', -1, from, to);
}
int unlink(const char *path) {
    REAL(int, unlink, const char *);
    if (!below(path)) return real(path);
    if (fails(0)) return -1;
    NOTED(int, real(path), 'U', -1, path, NULL);
}
int mkdir(const char *path, mode_t rights) {
    REAL(int, mkdir, const char *, mode_t);
    if (!below(path)) return real(path, rights);
    if (fails(1)) return -1;
    NOTED(int, real(path, rights), 'M', -1, path, NULL);
}
#define OPEN(name)                                                                 \
    int name(const char *path, int flags, ...) {                                   \
        REAL(int, name, const char *, int, ...);                                   \
        va_list more;                                                              \
        va_start(more, flags);                                                     \
        mode_t rights = va_arg(more, mode_t);                                      \
        va_end(more);                                                              \
        if (!(flags & (O_CREAT | O_TRUNC)) || !below(path)) return real(path, flags, rights);  \
        if ((flags & O_CREAT) && fails(1)) return -1;                              \
        NOTED(int, real(path, flags, rights), 'C', result, path, NULL);            \
    }
OPEN(open)
OPEN(open64)
