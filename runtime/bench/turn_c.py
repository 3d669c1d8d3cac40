"""The turn once more in C, and a device in C for the other end of a round trip: what `pans bench turn` compares with.

Owns both sources and how they are compiled; never part of a run. The loop in C does what the compiled turn does with ordinary messages of
one detector that walk an automaton, or of parallel frames that a table decides; it knows no case that is not ordinary.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

FLAGS = ("-O3", "-march=native")
COMMON = r"""
#include <stdint.h>
#include <string.h>
#include <time.h>
static uint32_t table[8][256];
static void make_tables(void) {
    for (int i = 0; i < 256; i++) {
        uint32_t c = i;
        for (int k = 0; k < 8; k++) c = c & 1 ? c >> 1 ^ 0xEDB88320u : c >> 1;
        table[0][i] = c;
    }
    for (int k = 1; k < 8; k++) for (int i = 0; i < 256; i++) table[k][i] = table[0][table[k - 1][i] & 255] ^ table[k - 1][i] >> 8;
}
static uint32_t crc(const uint8_t *p, int64_t n, uint32_t c) {
    c = ~c;
    for (; n >= 8; n -= 8, p += 8) {
        uint32_t a, b; memcpy(&a, p, 4); memcpy(&b, p + 4, 4); a ^= c;
        c = table[7][a & 255] ^ table[6][a >> 8 & 255] ^ table[5][a >> 16 & 255] ^ table[4][a >> 24]
          ^ table[3][b & 255] ^ table[2][b >> 8 & 255] ^ table[1][b >> 16 & 255] ^ table[0][b >> 24];
    }
    while (n--) c = table[0][(c ^ *p++) & 255] ^ c >> 8;
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
static int64_t now(void) { struct timespec t; clock_gettime(CLOCK_MONOTONIC, &t); return t.tv_sec * 1000000000ll + t.tv_nsec; }
"""
LOOP = (
    COMMON
    + r"""
#pragma pack(push, 1)
typedef struct { uint64_t index, tick, exposure; uint32_t object, shot, clicks; uint16_t label; int16_t truth; uint32_t flags;
                 float probability; uint32_t crc, exposures; } row_t;
#pragma pack(pop)
void prepare(void) { make_tables(); }

typedef struct { const uint8_t *data, *end; uint32_t session, schema, seq; uint8_t *kept; int64_t out; } wire_t;
static uint8_t body[70000];

/* The next message into `body`, kept as a record is; its size without the checksum, 0 at the end, -1 where it is not in order. */
static int64_t next(wire_t *w) {
    if (w->data >= w->end) return 0;
    const uint8_t *stop = memchr(w->data, 0, w->end - w->data);
    if (!stop) return -1;
    int64_t size = unstuff(w->data, stop - w->data, body) - 4;
    w->data = stop + 1;
    if (size < 12 || crc(body, size, w->schema) != u32(body + size) || u32(body + 4) != w->session || u32(body + 8) != w->seq++) return -1;
    memcpy(w->kept + w->out, body, size); w->out += size;
    if (w->out > 900000) w->out = 0;
    return size;
}

/* Frames in `data`: marks and CLICKS of a walk, one cycle for each object; rows of decisions out. Returns how many, -1 at anything else. */
int64_t walks(const uint8_t *data, int64_t n, uint32_t session, uint32_t schema, int64_t ticks, const uint32_t *successors, int64_t states,
              const uint16_t *labels, const float *probabilities, const int64_t *step_at, int64_t slots, int64_t features,
              const uint32_t *count_crc, uint32_t zero_crc, row_t *rows, uint8_t *kept, int64_t *steps) {
    int64_t rows_n = 0, exposure = 0, node = 0, clicks = 0, lit = 0, blocks = 0, size;
    uint32_t cc = zero_crc;
    int16_t truth = -1;
    wire_t wire = {data, data + n, session, schema, 0, kept, 0};
    while ((size = next(&wire)) > 0) {
        if (body[0] == 0x92) { truth = (int16_t)(body[16] | body[17] << 8); node = clicks = lit = 0; cc = zero_crc; continue; }
        if (body[0] != 0x90 || u64(body + 24) != (uint64_t)exposure) return -1;
        int64_t decoded = now(), count = body[36] | body[37] << 8, object = u32(body + 40);
        const uint8_t *stamps = body + 44, *bits = stamps + 2 * count;
        for (int64_t i = 0; i < count; i++) {
            int64_t step = step_at[exposure++ % slots], bit = bits[i >> 3] >> (i & 7) & 1;
            if (step < 0 || node >= states) continue;
            if ((stamps[2 * i] | stamps[2 * i + 1] << 8) != node) return -1;
            if (bit) { clicks++; cc ^= count_crc[step * 256 + 1]; }
            lit++;
            node = successors[2 * node + bit];
            if (node < states) continue;
            rows[rows_n & 8191] = (row_t){rows_n, ticks + u64(body + 16) + i * u32(body + 32), exposure - 1, object, 0,
                clicks, labels[node - states], truth, 0, probabilities[node - states], cc, lit};
            rows_n++;
        }
        int64_t decided = now(), *s = steps + 4 * (blocks++ & 1023);
        s[0] = decoded; s[1] = decided; s[2] = rows_n; s[3] = now();
    }
    return size ? -1 : rows_n;
}

/* FRAMES of words of `width` bytes that a table decides, every lit frame a row. */
int64_t words(const uint8_t *data, int64_t n, uint32_t session, uint32_t schema, int64_t ticks,
              const uint16_t *labels, const float *probabilities,
              const int64_t *word_rows, const uint32_t *word_crc, uint32_t zero_crc, const uint8_t *lit, int64_t slots, int64_t width,
              row_t *rows, uint8_t *kept) {
    int64_t rows_n = 0, exposure = 0, shot = 0, size;
    int16_t truth = -1;
    wire_t wire = {data, data + n, session, schema, 0, kept, 0};
    while ((size = next(&wire)) > 0) {
        if (body[0] == 0x92) { truth = (int16_t)(body[16] | body[17] << 8); continue; }
        if (body[0] != 0x91 || u64(body + 24) != (uint64_t)exposure) return -1;
        int64_t count = body[36] | body[37] << 8, object = u32(body + 40), slot = exposure % slots;
        if (!slot) shot = 0;
        const uint8_t *word = body + 44;
        for (int64_t i = 0; i < count; i++, exposure++, slot++, word += width) {
            if (!lit[slot]) continue;
            int64_t index = 0, clicks = 0; uint32_t cc = zero_crc;
            for (int64_t p = 0; p < width; p++) {
                index += word_rows[256 * p + word[p]]; cc ^= word_crc[256 * p + word[p]]; clicks += __builtin_popcount(word[p]);
            }
            rows[rows_n & 8191] = (row_t){rows_n, ticks + u64(body + 16) + i * u32(body + 32), exposure, object, shot,
                clicks, labels[index], truth, 0, probabilities[index], cc, 0};
            rows_n++, shot++;
        }
    }
    return size ? -1 : rows_n;
}
"""
)
DEVICE = (
    "#define _GNU_SOURCE\n"
    + COMMON
    + r"""
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>
#include <fcntl.h>
#include <termios.h>
#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
/* LISTEN MODE SESSION SCHEMA IN OUT SLOTS: behind a new pseudo-terminal (pty) or a TCP port of this machine (tcp), of which it prints the
   device URL first, until the other side closes. Mode 0 answers each IN bytes with OUT bytes. Mode 1 answers each SHOW as an instrument
   does: an acknowledgement, a MARK before a new object, and the CLICKS block of the exposure. */
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
    make_tables();
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
"""
)


def built(source: str, name: str, folder: Path, *flags: str) -> Path | str:
    """Compile `source` to `folder`/`name` with the system's C compiler; a word of explanation where that is not possible."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return "no C compiler (gcc or cc) on this machine: rows in C are left out"
    path, made = folder / f"{name}.c", folder / name
    path.write_text(source)
    done = subprocess.run([compiler, *FLAGS, *flags, "-o", str(made), str(path)], capture_output=True, text=True)
    if done.returncode:
        return f"{compiler} failed: {done.stderr.strip().splitlines()[-1:]}: rows in C are left out"
    return made


def loop_in_c(folder: Path) -> ctypes.CDLL | str:
    """Return the loops, ready; a word of explanation where there are none."""
    made = built(LOOP, "turn.so", folder, "-shared", "-fPIC")
    if isinstance(made, str):
        return made
    library = ctypes.CDLL(str(made))
    library.prepare()
    library.walks.restype = library.words.restype = ctypes.c_int64
    return library
