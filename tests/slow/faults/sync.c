/* Preloaded: fsync and fdatasync do as the file named by DENGINE_SYNC says: "hang" until that changes, or "fail"; where it
   says "back", the clock is an hour back. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

static char told(void)
{
    const char *path = getenv("DENGINE_SYNC");
    char said = 0;
    int file = path ? open(path, O_RDONLY) : -1;
    if (file >= 0) {
        if (read(file, &said, 1) < 1)
            said = 0;
        close(file);
    }
    return said;
}

static int meet(int fd, const char *name)
{
    for (;;) {
        char said = told();
        if (said == 'f') {
            errno = EIO;
            return -1;
        }
        if (said != 'h')
            return ((int (*)(int))dlsym(RTLD_NEXT, name))(fd);
        usleep(2000);
    }
}

int fsync(int fd) { return meet(fd, "fsync"); }
int fdatasync(int fd) { return meet(fd, "fdatasync"); }

int clock_gettime(clockid_t clock, struct timespec *now)
{
    int done = ((int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime"))(clock, now);
    if (clock == CLOCK_REALTIME && told() == 'b')
        now->tv_sec -= 3600;
    return done;
}
