/* The port and the clock: a pseudo-terminal or TCP, and the system's monotonic clock with an error of its own. */
#define _XOPEN_SOURCE 700
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "posix.h"

__extension__ typedef unsigned __int128 wide;

static uint64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

uint64_t clock_tick(const struct clock *clock)
{
    return clock->offset_ticks + (uint64_t)((wide)now_ns() * clock->tick_hz * clock->rate / 1000000000u / 1000000000u);
}

uint64_t clock_ns_until(const struct clock *clock, uint64_t tick)
{
    uint64_t now = clock_tick(clock), ticks = tick <= now ? 0 : tick - now;
    return ticks >= clock->tick_hz ? 1000000000u : ticks * 1000000000u / clock->tick_hz; /* no overflow: less than a second */
}

static void no_waiting(int descriptor)
{
    fcntl(descriptor, F_SETFL, fcntl(descriptor, F_GETFL) | O_NONBLOCK);
}

static void open_pty(struct port *port)
{
    port->client = posix_openpt(O_RDWR | O_NOCTTY);
    if (port->client < 0 || grantpt(port->client) != 0 || unlockpt(port->client) != 0)
        die("cannot open a pseudo-terminal", strerror(errno));
    const char *name = ptsname(port->client);
    port->other_end = open(name, O_RDWR | O_NOCTTY); /* kept open: a client may leave and come back */
    struct termios raw;
    if (port->other_end < 0 || tcgetattr(port->other_end, &raw) != 0)
        die("cannot open a pseudo-terminal", strerror(errno));
    raw.c_iflag = raw.c_oflag = raw.c_lflag = 0; /* before the first byte: an echo would answer the host with its own bytes */
    raw.c_cflag = (raw.c_cflag & ~(tcflag_t)(CSIZE | PARENB)) | CS8;
    tcsetattr(port->other_end, TCSANOW, &raw);
    no_waiting(port->client);
    snprintf(port->url, sizeof port->url, "serial://%s", name);
}

static void open_tcp(struct port *port, const char *host, unsigned number)
{
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((uint16_t)number)};
    socklen_t size = sizeof address;
    int yes = 1;
    port->listener = socket(AF_INET, SOCK_STREAM, 0);
    setsockopt(port->listener, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
    if (inet_pton(AF_INET, host, &address.sin_addr) != 1)
        die("not a numeric IPv4 address", host);
    if (bind(port->listener, (struct sockaddr *)&address, sizeof address) != 0 || listen(port->listener, 1) != 0)
        die("cannot listen", strerror(errno));
    getsockname(port->listener, (struct sockaddr *)&address, &size);
    no_waiting(port->listener);
    snprintf(port->url, sizeof port->url, "serial:socket://%s:%u", host, (unsigned)ntohs(address.sin_port));
}

void open_port(struct port *port, const char *listen_on)
{
    char host[64];
    unsigned number;
    *port = (struct port){.client = -1, .listener = -1, .other_end = -1};
    if (strcmp(listen_on, "pty") == 0)
        open_pty(port);
    else if (sscanf(listen_on, "tcp:%63[0-9.]:%5u", host, &number) == 2 && number < 65536)
        open_tcp(port, host, number);
    else
        die("cannot listen on", listen_on);
}

static void hang_up(struct port *port)
{
    if (port->listener >= 0 && port->client >= 0) {
        close(port->client);
        port->client = -1;
    }
}

static void welcome_client(struct port *port)
{
    int yes = 1;
    port->client = accept(port->listener, NULL, NULL);
    if (port->client < 0)
        return;
    no_waiting(port->client);
    setsockopt(port->client, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
}

size_t port_read(struct port *port, uint8_t *bytes, size_t room)
{
    if (port->client < 0)
        welcome_client(port);
    if (port->client < 0)
        return 0;
    ssize_t count = read(port->client, bytes, room);
    if (count > 0)
        return (size_t)count;
    if (count == 0 || (errno != EAGAIN && errno != EINTR))
        hang_up(port);
    return 0;
}

size_t port_write(struct port *port, const uint8_t *bytes, size_t count)
{
    if (port->client < 0 || count == 0)
        return count; /* nobody is there: lost */
    ssize_t took = port->listener >= 0 ? send(port->client, bytes, count, MSG_NOSIGNAL) : write(port->client, bytes, count);
    if (took >= 0)
        return (size_t)took;
    if (errno == EAGAIN || errno == EINTR)
        return 0;
    hang_up(port);
    return count;
}

void port_wait(const struct port *port, uint64_t most_ns, int wants_to_write)
{
    fd_set readable, writable;
    int source = port->client >= 0 ? port->client : port->listener;
    struct timespec most = {(time_t)(most_ns / 1000000000u), (long)(most_ns % 1000000000u)};
    FD_ZERO(&readable);
    FD_ZERO(&writable);
    FD_SET(source, &readable);
    FD_SET(STDIN_FILENO, &readable);
    if (wants_to_write && port->client >= 0)
        FD_SET(source, &writable);
    if (pselect(source + 1, &readable, &writable, NULL, &most, NULL) > 0 && FD_ISSET(STDIN_FILENO, &readable))
        exit(0); /* nothing was asked for, so whoever started this has gone */
}
