// A library to preload: it kills the process at one of its calls that change the files of a folder. A write is done by half first.
// With an error of a full disk, such as EDQUOT, that call and all later ones that take space fail instead.
// There are no hard links, as on some file systems.

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

static const char *watched;
static long left;
static int error;

// Kills the process at the call with this number, from 1, that changes a file in the folder.
void kill_at(const char *folder, long number) {
    watched = strdup(folder);
    left = number;
}

__attribute__((constructor)) static void from_environment(void) {
    if (getenv("KILL_FOLDER") && getenv("KILL_AT")) kill_at(getenv("KILL_FOLDER"), atol(getenv("KILL_AT")));
    if (getenv("KILL_ERROR")) error = atoi(getenv("KILL_ERROR"));
}

// Whether this call is the last one. TensorBoard's files, which no run reads, are written hundreds of times.
static int is_last(const char *path) {
    return watched && !strncmp(path, watched, strlen(watched)) && !strstr(path, "tfevents") && (--left == 0 || (error && left < 0));
}

static int is_last_of(int file) {
    char link[32], path[PATH_MAX] = "";
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    return watched && readlink(link, path, sizeof path - 1) > 0 && is_last(path);
}

// Folders are written after a file in them was replaced.
static int is_folder(int file) {
    struct stat status;
    return !fstat(file, &status) && S_ISDIR(status.st_mode);
}

static int fails(int is_last) {
    if (is_last && !error) kill(getpid(), SIGKILL);
    if (is_last) errno = error;
    return is_last;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

#define OPENS(name)                                                            \
    int name(const char *path, int flags, ...) {                               \
        va_list more;                                                          \
        va_start(more, flags);                                                 \
        mode_t mode = flags & O_CREAT ? va_arg(more, mode_t) : 0;              \
        va_end(more);                                                          \
        if (fails(flags & (O_CREAT | O_TRUNC) && is_last(path))) return -1;    \
        return REAL(name)(path, flags, mode);                                  \
    }
OPENS(open)
OPENS(open64)

#define CHANGES(name, parameters, arguments, is_last)                          \
    int name parameters {                                                      \
        if (fails(is_last)) return -1;                                         \
        return REAL(name) arguments;                                           \
    }
CHANGES(ftruncate, (int file, off_t length), (file, length), !error && is_last_of(file))
CHANGES(ftruncate64, (int file, off64_t length), (file, length), !error && is_last_of(file))
CHANGES(truncate, (const char *path, off_t length), (path, length), !error && is_last(path))
CHANGES(truncate64, (const char *path, off64_t length), (path, length), !error && is_last(path))
CHANGES(rename, (const char *from, const char *to), (from, to), !error && is_last(to))
CHANGES(unlink, (const char *path), (path), !error && is_last(path))
CHANGES(mkdir, (const char *path, mode_t mode), (path, mode), is_last(path))
CHANGES(fsync, (int file), (file), error && !is_folder(file) && is_last_of(file))
CHANGES(fdatasync, (int file), (file), error && is_last_of(file))

ssize_t write(int file, const void *content, size_t size) {
    if (is_last_of(file)) {
        if (!error) REAL(write)(file, content, size / 2);
        if (fails(1)) return -1;
    }
    return REAL(write)(file, content, size);
}

int link(const char *from, const char *to) {
    (void)from, (void)to, errno = EPERM;
    return -1;
}

int linkat(int of, const char *from, int in, const char *to, int flags) {
    (void)of, (void)in, (void)flags;
    return link(from, to);
}
