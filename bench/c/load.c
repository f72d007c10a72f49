/*
 * The load generator: keeps every connection of a Modbus TCP server full of requests and measures the answers.
 *
 * For: the server tables. It keeps `in_flight` requests pipelined on each connection; requests that become due
 * together (because one read brought several replies) leave in one write. It knows MBAP and ten functions, and trusts
 * no answer: every reply is held against the request it claims to answer. Compiled with -DTLS it speaks TLS.
 *
 * Rules:
 * 1. A reply must carry an identifier that is outstanding on its connection, protocol 0, the length, unit, function
 *    and byte count (or, of a write, echo) that fit the request. Anything else ends the run with a sentence and exit code 1.
 * 2. Replies may leave the server in any order.
 * 3. The first part of the run (a fifth of `seconds`, 0.1 s at least) warms up and is not counted in rate and latency.
 * 4. Five seconds without any reply end the run with exit code 1.
 * 5. Latency runs from the write that carried a request to the read that brought its reply (one clock reading per
 *    read and write, not per request), of every transaction, in a histogram whose steps are 1.6 % wide.
 *
 * 6. TLS: sockets block, and one SSL_read per wake-up takes one record; what is left stays in the kernel, which tells
 *    again. Both sides show certificates; the name in the server's is not looked at.
 *
 * 7. Mixed traffic is 20 000 requests that all differ, of functions 01 to 06, 15, 16, 22 and 23 in turn, over addresses
 *    and counts that are drawn once from a fixed seed. Each reply must have the function and the length that its
 *    request calls for, and echo what a write echoes.
 *
 * 8. Over UDP each request is a datagram of its own, and each reply is one; requests that became due together leave in
 *    one system call. A datagram that is lost is an error: loopback loses none while the buffers hold all in flight.
 * 9. RTU over TCP has no identifiers: replies come in the order of the requests, and each CRC is computed and checked.
 *
 * Use: load HOST PORT CONNECTIONS IN_FLIGHT REGISTERS SECONDS [FUNCTION [tcp|udp|rtu]]
 *      load_tls HOST PORT CONNECTIONS IN_FLIGHT REGISTERS SECONDS FUNCTION CERTIFICATE KEY AUTHORITY
 *      IN_FLIGHT 1…256, REGISTERS 1…125 (of a write 1…123), FUNCTION 3, 6 or 16, 3 when left out, 0 for mixed traffic
 *      (REGISTERS is then the most that one request is about, 1…100); udp and rtu go with FUNCTION 3; prints one line of JSON:
 *      transactions, seconds, rate (per second), p50/p99/p99.9 (µs) of the counted part; all_transactions since the
 *      first byte (to divide the CPU time of the server by); cpu (seconds, of this process); errors.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>
#ifdef TLS
#include <openssl/ssl.h>
#endif

enum {
    REQUEST = 12,           /* of FC03 and FC06 */
    LONGEST_REQUEST = 13 + 2 * 123,
    HEADER = 9,             /* MBAP 7, function 1, byte count 1 */
    SLOTS = 256,            /* the low byte of an identifier is its slot, the high byte counts the uses of the slot */
    LONGEST_FRAME = 6 + 254,
    READ_SIZE = 262144,
    EVENTS = 512,
    STEPS = 64,             /* of the histogram, per power of two */
    PREPARED = 20000,       /* requests of mixed traffic */
    MIXED_ITEMS = 65000,    /* addresses that mixed traffic is about */
};

/* A request of mixed traffic, and what its reply must be like. */
struct prepared {
    uint8_t bytes[LONGEST_REQUEST];
    uint16_t size, reply_size;
    uint8_t echoes; /* bytes after the function that a reply repeats */
};

struct slot {
    uint16_t identifier;
    uint16_t prepared; /* of mixed traffic */
    uint8_t outstanding;
    uint64_t sent; /* ns */
};

struct connection {
    int socket;
    unsigned next; /* slot of the oldest request, of RTU */
#ifdef TLS
    SSL *secure;
#endif
    int kept;
    uint8_t rest[LONGEST_FRAME];
    struct slot slots[SLOTS];
};

enum transport { TCP, UDP, RTU };
static enum transport transport = TCP;
static int registers, function = 3, in_flight;
static const uint8_t unit = 1;
static size_t reply_size;
#ifdef TLS
static SSL_CTX *credentials;
#endif
static struct prepared *mixed;
static unsigned next_prepared;
static uint64_t histogram[64 * STEPS];
static uint64_t all_transactions, counted;
static int counting;

static void fail(const char *format, ...) {
    va_list values;
    va_start(values, format);
    fputs("load: ", stderr);
    vfprintf(stderr, format, values);
    fputc('\n', stderr);
    va_end(values);
    printf("{\"errors\": 1, \"all_transactions\": %llu}\n", (unsigned long long)all_transactions);
    exit(1);
}

static uint64_t now(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (uint64_t)time.tv_sec * 1000000000u + (uint64_t)time.tv_nsec;
}

/* Values below STEPS have a cell each; above, each power of two has STEPS cells. */
static unsigned cell_of(uint64_t value) {
    if (value < STEPS) return (unsigned)value;
    unsigned shift = 63 - (unsigned)__builtin_clzll(value) - 6;
    return (shift + 1) * STEPS + (unsigned)((value >> shift) - STEPS);
}

static double middle_of(unsigned cell) {
    if (cell < STEPS) return cell;
    unsigned shift = cell / STEPS - 1;
    return ((double)(STEPS + cell % STEPS) + 0.5) * (double)(1ull << shift);
}

static double percentile(double share) {
    uint64_t wanted = (uint64_t)(share * (double)counted), seen = 0;
    for (unsigned cell = 0; cell < sizeof histogram / sizeof *histogram; cell++) {
        seen += histogram[cell];
        if (seen > wanted) return middle_of(cell) / 1000.0;
    }
    return 0.0;
}

static uint32_t drawn(uint32_t below) {
    static uint32_t state = 2463534242u;
    state ^= state << 13;
    state ^= state >> 17;
    state ^= state << 5;
    return state % below;
}

static uint8_t *put_number(uint8_t *at, unsigned value) {
    *at++ = (uint8_t)(value >> 8);
    *at++ = (uint8_t)value;
    return at;
}

/* Fills in one request of mixed traffic. */
static void prepare(struct prepared *one, int of) {
    unsigned count = 1 + drawn((unsigned)registers), address = drawn(MIXED_ITEMS - (unsigned)registers);
    unsigned bits = 8 * count, bytes = of == 15 ? count : 2 * count, reply = 4; /* behind the function */
    uint8_t *at = one->bytes + 7;
    *at++ = (uint8_t)of;
    at = put_number(at, address);
    one->echoes = 4;
    switch (of) {
    case 1: case 2: at = put_number(at, bits); one->echoes = 0; reply = 1 + count; break;
    case 3: case 4: at = put_number(at, count); one->echoes = 0; reply = 1 + 2 * count; break;
    case 5: at = put_number(at, drawn(2) ? 0xFF00 : 0); break;
    case 6: at = put_number(at, drawn(65536)); break;
    case 22: at = put_number(at, 0xF0F0); at = put_number(at, drawn(65536)); one->echoes = 6; reply = 6; break;
    case 23:
        at = put_number(at, count);
        at = put_number(at, drawn(MIXED_ITEMS - (unsigned)registers));
        one->echoes = 0;
        reply = 1 + 2 * count;
    /* fall through */
    default: /* 15 and 16 */
        at = put_number(at, of == 15 ? bits : count);
        *at++ = (uint8_t)bytes;
        for (unsigned index = 0; index < bytes; index++) *at++ = (uint8_t)drawn(256);
    }
    one->size = (uint16_t)(at - one->bytes);
    one->reply_size = (uint16_t)(8 + reply);
    one->bytes[5] = (uint8_t)(one->size - 6);
    one->bytes[6] = unit;
}

static void prepare_mixed(void) {
    static const int functions[] = {1, 2, 3, 4, 5, 6, 15, 16, 22, 23};
    mixed = calloc(PREPARED, sizeof *mixed);
    if (!mixed) fail("no memory");
    for (int index = 0; index < PREPARED; index++) prepare(&mixed[index], functions[index % 10]);
}

static uint8_t *put_request(uint8_t *at, struct connection *link, unsigned slot) {
    uint16_t identifier = link->slots[slot].identifier;
    if (mixed) {
        const struct prepared *one = &mixed[next_prepared];
        link->slots[slot].outstanding = 1;
        link->slots[slot].prepared = (uint16_t)next_prepared;
        next_prepared = (next_prepared + 1) % PREPARED;
        memcpy(at, one->bytes, one->size);
        put_number(at, identifier);
        return at + one->size;
    }
    unsigned following = function == 16 ? 7u + 2u * (unsigned)registers : 6u;
    link->slots[slot].outstanding = 1;
    memset(at, 0, 6 + following);
    at[0] = (uint8_t)(identifier >> 8);
    at[1] = (uint8_t)identifier;
    at[4] = (uint8_t)(following >> 8);
    at[5] = (uint8_t)following;
    at[6] = unit;
    at[7] = (uint8_t)function;
    at[11] = (uint8_t)(function == 6 ? slot : registers); /* value, or count */
    if (function == 16) {
        at[12] = (uint8_t)(2 * registers);
        at[14] = (uint8_t)slot; /* the first register changes, the others are 0 */
    }
    return at + 6 + following;
}

/* Sends all; a TLS socket blocks, so that one write takes it. */
static void send_all(struct connection *link, const uint8_t *bytes, size_t size) {
#ifdef TLS
    if (SSL_write(link->secure, bytes, (int)size) != (int)size) fail("a write failed");
#else
    while (size > 0) {
        ssize_t sent = send(link->socket, bytes, size, MSG_NOSIGNAL);
        if (sent > 0) {
            bytes += sent;
            size -= (size_t)sent;
        } else if (errno == EAGAIN) {
            struct pollfd writable = {.fd = link->socket, .events = POLLOUT};
            if (poll(&writable, 1, 5000) <= 0) fail("the server took no bytes for 5 s");
        } else if (errno != EINTR) {
            fail("a write failed: %s", strerror(errno));
        }
    }
#endif
}

static ssize_t receive(struct connection *link, uint8_t *bytes, size_t size) {
#ifdef TLS
    int got = SSL_read(link->secure, bytes, (int)size);
    if (got < 0) fail("a read failed: error %d of TLS", SSL_get_error(link->secure, got));
    return got;
#else
    return recv(link->socket, bytes, size, 0);
#endif
}

/* Whether the part of a reply behind its function fits the request that had this slot. */
static int fits(const uint8_t *frame, unsigned slot, const struct prepared *one) {
    if (one) return one->echoes ? !memcmp(frame + 8, one->bytes + 8, one->echoes) : frame[8] == one->reply_size - 9;
    if (function == 3) return frame[8] == 2 * registers;
    if (frame[8] | frame[9] | frame[10]) return 0; /* address 0, and the high byte of what was written or counted */
    return frame[11] == (function == 6 ? (uint8_t)slot : registers);
}

#ifndef TLS
static uint16_t crc_table[256];

static void prepare_crc(void) {
    for (unsigned byte = 0; byte < 256; byte++) {
        unsigned crc = byte;
        for (int bit = 0; bit < 8; bit++) crc = crc & 1 ? crc >> 1 ^ 0xA001 : crc >> 1;
        crc_table[byte] = (uint16_t)crc;
    }
}

static unsigned crc_of(const uint8_t *bytes, size_t size) {
    unsigned crc = 0xFFFF;
    while (size--) crc = crc >> 8 ^ crc_table[(crc ^ *bytes++) & 0xFF];
    return crc;
}

/* An RTU frame for the request of a slot; the transaction identifier stays with the slot. */
static uint8_t *put_rtu(uint8_t *at, struct connection *link, unsigned slot) {
    uint8_t mbap[LONGEST_REQUEST];
    put_request(mbap, link, slot);
    memcpy(at, mbap + 6, 6);
    unsigned crc = crc_of(at, 6);
    at[6] = (uint8_t)crc;
    at[7] = (uint8_t)(crc >> 8);
    return at + 8;
}

/* Marks the request of a slot as answered. */
static void answered(struct slot *slot, uint64_t arrived) {
    slot->outstanding = 0;
    slot->identifier = (uint16_t)(slot->identifier + SLOTS);
    all_transactions++;
    if (counting) {
        counted++;
        histogram[cell_of(arrived - slot->sent)]++;
    }
}

static void turn_rtu(struct connection *link) {
    static uint8_t incoming[LONGEST_FRAME + READ_SIZE], outgoing[SLOTS * 8];
    memcpy(incoming, link->rest, (size_t)link->kept);
    ssize_t got = recv(link->socket, incoming + link->kept, READ_SIZE, 0);
    if (got == 0) fail("the server closed a connection");
    if (got < 0) {
        if (errno == EAGAIN || errno == EINTR) return;
        fail("a read failed: %s", strerror(errno));
    }
    const uint64_t arrived = now();
    const size_t size = (size_t)(link->kept + got), whole = 5 + 2 * (size_t)registers;
    size_t at = 0;
    uint8_t *end = outgoing;
    for (; size - at >= whole; at += whole) {
        const uint8_t *frame = incoming + at;
        struct slot *slot = &link->slots[link->next];
        if (!slot->outstanding) fail("a reply answers nothing");
        if (frame[0] != unit || frame[1] != 3 || frame[2] != 2 * registers) fail("a reply does not fit its request");
        if (crc_of(frame, whole)) fail("a reply has a bad CRC");
        answered(slot, arrived);
        slot->sent = arrived;
        end = put_rtu(end, link, link->next);
        link->next = (link->next + 1) % (unsigned)in_flight;
    }
    link->kept = (int)(size - at);
    if (link->kept > LONGEST_FRAME) fail("a reply is longer than a frame");
    memcpy(link->rest, incoming + at, (size_t)link->kept);
    if (end != outgoing) send_all(link, outgoing, (size_t)(end - outgoing));
}

static void send_datagrams(struct connection *link, const unsigned *due, unsigned count) {
    static uint8_t bytes[SLOTS][REQUEST];
    static struct iovec parts[SLOTS];
    static struct mmsghdr messages[SLOTS];
    uint64_t sent = now();
    for (unsigned index = 0; index < count; index++) {
        put_request(bytes[index], link, due[index]);
        link->slots[due[index]].sent = sent;
        parts[index] = (struct iovec){bytes[index], REQUEST};
        messages[index].msg_hdr = (struct msghdr){.msg_iov = &parts[index], .msg_iovlen = 1};
    }
    for (unsigned at = 0; at < count;) {
        int done = sendmmsg(link->socket, messages + at, count - at, 0);
        if (done < 0) fail("a write failed: %s", strerror(errno));
        at += (unsigned)done;
    }
}

static void turn_udp(struct connection *link) {
    static uint8_t bytes[SLOTS][LONGEST_FRAME];
    static struct iovec parts[SLOTS];
    static struct mmsghdr messages[SLOTS];
    unsigned due[SLOTS];
    for (unsigned index = 0; index < SLOTS; index++) {
        parts[index] = (struct iovec){bytes[index], LONGEST_FRAME};
        messages[index].msg_hdr = (struct msghdr){.msg_iov = &parts[index], .msg_iovlen = 1};
    }
    int got = recvmmsg(link->socket, messages, SLOTS, MSG_DONTWAIT, NULL);
    if (got < 0) {
        if (errno == EAGAIN || errno == EINTR) return;
        fail("a read failed: %s", strerror(errno));
    }
    uint64_t arrived = now();
    for (int index = 0; index < got; index++) {
        const uint8_t *frame = bytes[index];
        unsigned identifier = (unsigned)(frame[0] << 8 | frame[1]), slot = identifier % SLOTS;
        if (messages[index].msg_len != reply_size) fail("a reply has %u bytes", messages[index].msg_len);
        if (!link->slots[slot].outstanding || link->slots[slot].identifier != identifier)
            fail("a reply carries transaction identifier %u, which is not outstanding", identifier);
        if (frame[2] | frame[3] | frame[4] || frame[5] != reply_size - 6 || frame[6] != unit || frame[7] != 3 ||
            frame[8] != 2 * registers)
            fail("a reply does not fit its request");
        answered(&link->slots[slot], arrived);
        due[index] = slot;
    }
    send_datagrams(link, due, (unsigned)got);
}
#endif

/* Takes what arrived on one connection and sends as many new requests as replies came. */
static void turn(struct connection *link) {
    static uint8_t incoming[LONGEST_FRAME + READ_SIZE];
    static uint8_t outgoing[SLOTS * LONGEST_REQUEST];
    unsigned due[SLOTS];
    int due_count = 0;

#ifndef TLS
    if (transport == RTU) {
        turn_rtu(link);
        return;
    }
    if (transport == UDP) {
        turn_udp(link);
        return;
    }
#endif
    memcpy(incoming, link->rest, (size_t)link->kept);
    ssize_t got = receive(link, incoming + link->kept, READ_SIZE);
    if (got == 0) fail("the server closed a connection");
    if (got < 0) {
        if (errno == EAGAIN || errno == EINTR) return;
        fail("a read failed: %s", strerror(errno));
    }
    uint64_t arrived = now();
    size_t size = (size_t)(link->kept + got), at = 0;
    while (size - at >= HEADER) {
        const uint8_t *frame = incoming + at;
        unsigned identifier = (unsigned)(frame[0] << 8 | frame[1]);
        unsigned length = (unsigned)(frame[4] << 8 | frame[5]);
        struct slot *slot = &link->slots[identifier % SLOTS];
        if (!slot->outstanding || slot->identifier != identifier)
            fail("a reply carries transaction identifier %u, which is not outstanding", identifier);
        if (frame[7] & 0x80) fail("the server answered with exception %u", frame[8]);
        if (frame[2] | frame[3]) fail("a reply has protocol identifier %u", frame[2] << 8 | frame[3]);
        const struct prepared *one = mixed ? &mixed[slot->prepared] : NULL;
        const size_t whole = one ? one->reply_size : reply_size;
        const int asked = one ? one->bytes[7] : function;
        if (frame[6] != unit || frame[7] != asked)
            fail("a reply has unit %u and function %u, %u and %d were asked", frame[6], frame[7], unit, asked);
        if (length != whole - 6) fail("a reply of function %d has length %u, not %zu", asked, length, whole - 6);
        if (size - at < whole) break;
        if (!fits(frame, identifier % SLOTS, one)) fail("a reply of function %d does not fit its request", asked);
        slot->outstanding = 0;
        slot->identifier = (uint16_t)(identifier + SLOTS);
        due[due_count++] = identifier % SLOTS;
        all_transactions++;
        if (counting) {
            counted++;
            histogram[cell_of(arrived - slot->sent)]++;
        }
        at += whole;
    }
    link->kept = (int)(size - at);
    memcpy(link->rest, incoming + at, (size_t)link->kept);
    if (!due_count) return;
    uint8_t *end = outgoing;
    uint64_t sent = now();
    for (int index = 0; index < due_count; index++) {
        end = put_request(end, link, due[index]);
        link->slots[due[index]].sent = sent;
    }
    send_all(link, outgoing, (size_t)(end - outgoing));
}

static int dial(const struct addrinfo *address) {
    int on = 1;
    int socket_ = socket(address->ai_family, (transport == UDP ? SOCK_DGRAM : SOCK_STREAM) | SOCK_CLOEXEC, 0);
    if (socket_ < 0) fail("no socket: %s", strerror(errno));
    if (connect(socket_, address->ai_addr, address->ai_addrlen)) fail("connect: %s", strerror(errno));
    if (transport != UDP) setsockopt(socket_, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    return socket_;
}

#ifdef TLS
static void agree_on_credentials(const char *certificate, const char *key, const char *authority) {
    credentials = SSL_CTX_new(TLS_client_method());
    if (!credentials || SSL_CTX_use_certificate_chain_file(credentials, certificate) != 1 ||
        SSL_CTX_use_PrivateKey_file(credentials, key, SSL_FILETYPE_PEM) != 1 ||
        SSL_CTX_load_verify_locations(credentials, authority, NULL) != 1)
        fail("the certificate, the key or the authority cannot be used");
    SSL_CTX_set_verify(credentials, SSL_VERIFY_PEER, NULL);
}

static SSL *shake_hands(int socket) {
    SSL *secure = SSL_new(credentials);
    if (!secure || SSL_set_fd(secure, socket) != 1 || SSL_connect(secure) != 1) fail("no agreement on TLS");
    return secure;
}
#endif

static long number(const char *text, const char *name, long low, long high) {
    char *end;
    long value = strtol(text, &end, 10);
    if (*end || value < low || value > high) fail("%s is %s, allowed are %ld…%ld", name, text, low, high);
    return value;
}

int main(int argc, char **argv) {
#ifdef TLS
    if (argc != 11)
        fail("use: load_tls HOST PORT CONNECTIONS IN_FLIGHT REGISTERS SECONDS FUNCTION CERTIFICATE KEY AUTHORITY");
    agree_on_credentials(argv[8], argv[9], argv[10]);
#else
    if (argc < 7 || argc > 9)
        fail("use: load HOST PORT CONNECTIONS IN_FLIGHT REGISTERS SECONDS [FUNCTION [tcp|udp|rtu]]");
    if (argc == 9) transport = !strcmp(argv[8], "udp") ? UDP : !strcmp(argv[8], "rtu") ? RTU : TCP;
    if (argc == 9 && transport == TCP && strcmp(argv[8], "tcp")) fail("TRANSPORT is %s, not tcp, udp or rtu", argv[8]);
    prepare_crc();
#endif
    int connections = (int)number(argv[3], "CONNECTIONS", 1, 60000);
    in_flight = (int)number(argv[4], "IN_FLIGHT", 1, SLOTS);
    registers = (int)number(argv[5], "REGISTERS", 1, 125);
    double seconds = strtod(argv[6], NULL);
    if (!(seconds > 0 && seconds <= 3600)) fail("SECONDS is %s, allowed are 0…3600", argv[6]);
    if (argc > 7) function = (int)number(argv[7], "FUNCTION", 0, 16);
    if (function && function != 3 && function != 6 && function != 16)
        fail("FUNCTION is %d, allowed are 0, 3, 6 and 16", function);
    if (!function && registers > 100) fail("REGISTERS is %d, mixed traffic takes 1…100", registers);
    if (transport != TCP && function != 3) fail("udp and rtu go with FUNCTION 3, not %d", function);
    if (!function) prepare_mixed();
    if (function == 16 && registers > 123) fail("REGISTERS is %d, a write takes 1…123", registers);
    reply_size = function == 3 ? (size_t)(HEADER + 2 * registers) : REQUEST;

    struct rlimit files;
    getrlimit(RLIMIT_NOFILE, &files);
    files.rlim_cur = files.rlim_max;
    setrlimit(RLIMIT_NOFILE, &files);

    struct addrinfo wanted = {.ai_socktype = transport == UDP ? SOCK_DGRAM : SOCK_STREAM}, *address;
    int problem = getaddrinfo(argv[1], argv[2], &wanted, &address);
    if (problem) fail("%s: %s", argv[1], gai_strerror(problem));
    struct connection *links = calloc((size_t)connections, sizeof *links);
    if (!links) fail("no memory");
    int poller = epoll_create1(EPOLL_CLOEXEC);
    for (int index = 0; index < connections; index++) {
        links[index].socket = dial(address);
#ifdef TLS
        links[index].secure = shake_hands(links[index].socket);
#endif
        struct epoll_event event = {.events = EPOLLIN, .data.ptr = &links[index]};
        if (epoll_ctl(poller, EPOLL_CTL_ADD, links[index].socket, &event)) fail("epoll_ctl: %s", strerror(errno));
    }

    static uint8_t first[SLOTS * LONGEST_REQUEST];
    for (int index = 0; index < connections; index++) {
        uint8_t *end = first;
        uint64_t sent = now();
        for (unsigned slot = 0; slot < (unsigned)in_flight; slot++) {
            links[index].slots[slot].identifier = (uint16_t)slot;
            links[index].slots[slot].sent = sent;
#ifndef TLS
            if (transport == RTU) end = put_rtu(end, &links[index], slot);
            else
#endif
            if (transport == TCP) end = put_request(end, &links[index], slot);
        }
#ifndef TLS
        if (transport == UDP) {
            unsigned due[SLOTS];
            for (unsigned slot = 0; slot < (unsigned)in_flight; slot++) due[slot] = slot;
            send_datagrams(&links[index], due, (unsigned)in_flight);
            continue;
        }
#endif
        send_all(&links[index], first, (size_t)(end - first));
    }

    double warm = seconds / 5 > 0.1 ? seconds / 5 : 0.1;
    uint64_t begin = now(), start = begin + (uint64_t)(warm * 1e9), stop = start + (uint64_t)(seconds * 1e9);
    uint64_t counted_since = 0, at = begin;
    struct epoll_event ready[EVENTS];
    while (at < stop) {
        int count = epoll_wait(poller, ready, EVENTS, 5000);
        if (count == 0) fail("no reply for 5 s");
        for (int index = 0; index < count; index++) turn(ready[index].data.ptr);
        at = now();
        if (!counting && at >= start) {
            counting = 1;
            counted_since = at;
        }
    }
    double lasted = (double)(at - counted_since) / 1e9;
    if (!counted) fail("no transaction was counted");
    struct rusage used;
    getrusage(RUSAGE_SELF, &used);
    printf("{\"transactions\": %llu, \"all_transactions\": %llu, \"seconds\": %.6f, \"rate\": %.1f, "
           "\"p50\": %.1f, \"p99\": %.1f, \"p99.9\": %.1f, \"cpu\": %.6f, \"errors\": 0}\n",
           (unsigned long long)counted, (unsigned long long)all_transactions, lasted, (double)counted / lasted,
           percentile(0.50), percentile(0.99), percentile(0.999),
           used.ru_utime.tv_sec + used.ru_stime.tv_sec + (used.ru_utime.tv_usec + used.ru_stime.tv_usec) / 1e6);
    return 0;
}
