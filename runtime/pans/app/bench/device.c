/* LISTEN MODE SESSION SCHEMA IN OUT SLOTS: behind a new pseudo-terminal (pty) or a TCP port of this machine (tcp), of which it prints the
   device URL first, until the other side closes. Mode 0 answers each IN bytes with OUT bytes. Mode 1 answers each SHOW as an instrument
   does: an acknowledgement, a MARK before a new object, and the CLICKS block of the exposure. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <unistd.h>
static uint32_t table[256];
static void make_table(void) {
    for (int i = 0; i < 256; i++) {
        uint32_t c = i;
        for (int k = 0; k < 8; k++) c = c & 1 ? c >> 1 ^ 0xEDB88320u : c >> 1;
        table[i] = c;
    }
}
static uint32_t crc(const uint8_t *p, int64_t n, uint32_t c) {
    c = ~c;
    while (n--) c = table[(c ^ *p++) & 255] ^ c >> 8;
    return ~c;
}
static int64_t unstuff(const uint8_t *s, int64_t n, uint8_t *d) {
    int64_t i = 0, o = 0;
    while (i < n) {
        int64_t k = s[i++];
        if (!k || i + k - 1 > n) return -1;
        memcpy(d + o, s + i, k - 1); o += k - 1; i += k - 1;
        if (k < 255 && i < n) d[o++] = 0;
    }
    return o;
}
static int64_t stuff(const uint8_t *s, int64_t n, uint8_t *d) {
    int64_t at = 0, o = 1; uint8_t k = 1;
    for (int64_t i = 0; i < n; i++) {
        if (!s[i]) { d[at] = k; at = o++; k = 1; }
        else { d[o++] = s[i]; if (++k == 255) { d[at] = k; at = o++; k = 1; } }
    }
    d[at] = k; d[o++] = 0;
    return o;
}
static uint32_t u32(const uint8_t *p) { uint32_t v; memcpy(&v, p, 4); return v; }
static uint64_t u64(const uint8_t *p) { uint64_t v; memcpy(&v, p, 8); return v; }
static uint8_t in[1 << 16], out[1 << 12], body[1 << 12];
static int fd;
static void all(const uint8_t *p, int64_t n) { while (n) { int64_t k = write(fd, p, n); if (k <= 0) exit(1); p += k; n -= k; } }
static int64_t framed(uint8_t *b, int64_t n, uint32_t schema, uint8_t *d) {
    uint32_t c = crc(b, n, schema);
    memcpy(b + n, &c, 4);
    return stuff(b, n + 4, d);
}
int main(int argc, char **v) {
    int mode = atoi(v[2]), slots = atoi(v[7]);
    uint32_t session = strtoul(v[3], 0, 10), schema = strtoul(v[4], 0, 10), seq = 0;
    int64_t n_in = atol(v[5]), n_out = atol(v[6]), have = 0;
    make_table();
    if (strcmp(v[1], "pty") == 0) {
        struct termios t;
        fd = posix_openpt(O_RDWR | O_NOCTTY);
        if (fd < 0 || grantpt(fd) || unlockpt(fd)) return 1;
        int other = open(ptsname(fd), O_RDWR | O_NOCTTY); /* stays open: nothing hangs up before the host opens it */
        if (other < 0 || tcgetattr(other, &t)) return 1;
        cfmakeraw(&t); tcsetattr(other, TCSANOW, &t);
        printf("serial:%s\n", ptsname(fd)); fflush(stdout);
    } else {
        struct sockaddr_in a = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
        socklen_t size = sizeof a;
        int one = 1, server = socket(AF_INET, SOCK_STREAM, 0);
        if (bind(server, (void *)&a, size) || listen(server, 1) || getsockname(server, (void *)&a, &size)) return 1;
        printf("serial:socket://127.0.0.1:%d\n", ntohs(a.sin_port)); fflush(stdout);
        if ((fd = accept(server, 0, 0)) < 0) return 1;
        setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    }
    memset(out, 1, sizeof out);
    for (;;) {
        int64_t n = read(fd, in + have, sizeof in - have);
        if (n <= 0) return 0;
        have += n;
        if (mode == 0) { while (have >= n_in) { all(out, n_out); have -= n_in; } continue; }
        uint8_t *at = in, *end = in + have, *stop;
        while ((stop = memchr(at, 0, end - at))) {
            int64_t size = unstuff(at, stop - at, body) - 4, used = 0;
            at = stop + 1;
            if (size < 32 || crc(body, size, schema) != u32(body + size) || body[0] != 3 || body[12] != 9) continue;
            uint32_t id = u32(body + 8);
            uint64_t exposure = u64(body + 16), tick = exposure * 100;
            uint16_t state = body[24] | body[25] << 8;
            uint8_t b[64] = {0x83}; uint32_t object = exposure / slots; float photons = 1;
            memcpy(b + 4, &session, 4); memcpy(b + 8, &id, 4);
            used += framed(b, 24, schema, out + used);
            if (exposure % slots == 0) {
                memset(b, 0, 64); b[0] = 0x92; uint64_t first = exposure;
                memcpy(b + 4, &session, 4); memcpy(b + 8, &seq, 4); seq++; memcpy(b + 12, &object, 4); memcpy(b + 20, &first, 8);
                memcpy(b + 28, &tick, 8); memcpy(b + 36, &photons, 4);
                used += framed(b, 40, schema, out + used);
            }
            memset(b, 0, 64); b[0] = 0x90; uint32_t period = 100; uint16_t count = 1;
            memcpy(b + 4, &session, 4); memcpy(b + 8, &seq, 4); seq++; memcpy(b + 16, &tick, 8); memcpy(b + 24, &exposure, 8);
            memcpy(b + 32, &period, 4); memcpy(b + 36, &count, 2); memcpy(b + 40, &object, 4); memcpy(b + 44, &state, 2);
            b[46] = (exposure * 2654435761u >> 16) & 1;
            used += framed(b, 47, schema, out + used);
            all(out, used);
        }
        memmove(in, at, end - at); have = end - at;
    }
}
