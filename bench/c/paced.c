/*
 * The paced load generator: many connections, each of which asks for 10 registers (FC03) at its own fixed times.
 *
 * For: the table of connections. It knows MBAP and FC03 and trusts no reply: each one is held against its request.
 *
 * Rules:
 * 1. The questions of all connections are spread evenly over the period. A question is due at its time, whatever came
 *    of those before; its latency runs from that time, so that a server (or a generator) that falls behind shows.
 * 2. A reply that has not come when the next question of its connection is due is missing; that question is not asked,
 *    and the connection waits for the reply.
 * 3. Each connection makes one transaction when it is dialled, so that the server has accepted it. The first period is
 *    not counted. Five seconds without any reply end the run with exit code 1.
 *
 * Use: paced HOST PORT CONNECTIONS PERIOD SECONDS SERVER
 *      PERIOD is the time of a connection between two questions, in seconds; SERVER is the process that is asked. Prints
 *      one line of JSON about the counted part: transactions, seconds, rate (per second), p50/p99/p99.9/longest (µs),
 *      late (replies after more than 100 ms), missing, cpu (seconds, of this process), server (of that process).
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
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

enum { REQUEST = 12, REGISTERS = 10, REPLY = 9 + 2 * REGISTERS, EVENTS = 512, LATE = 100000000 /* ns */, UNIT = 1 };

struct connection {
    int socket;
    int kept;
    int outstanding;
    uint16_t identifier;
    uint64_t due; /* ns, of the question that is on its way */
    uint8_t reply[REPLY];
};

static uint64_t counted_from, counted, late, missing, room;
static double *latencies; /* µs */

static void fail(const char *format, ...) {
    va_list values;
    va_start(values, format);
    fputs("paced: ", stderr);
    vfprintf(stderr, format, values);
    fputc('\n', stderr);
    va_end(values);
    exit(1);
}

static uint64_t now(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (uint64_t)time.tv_sec * 1000000000u + (uint64_t)time.tv_nsec;
}

/* CPU time of a process, all its threads: see clock_getcpuclockid(3). */
static double cpu_of(pid_t process) {
    clockid_t clock;
    struct timespec time;
    if (clock_getcpuclockid(process, &clock) || clock_gettime(clock, &time))
        fail("the CPU time of process %d cannot be read", process);
    return (double)time.tv_sec + (double)time.tv_nsec / 1e9;
}

static void ask(struct connection *link, uint64_t due) {
    uint8_t request[REQUEST] = {0, 0, 0, 0, 0, 6, UNIT, 3, 0, 0, 0, REGISTERS};
    link->identifier++;
    request[0] = (uint8_t)(link->identifier >> 8);
    request[1] = (uint8_t)link->identifier;
    link->due = due;
    link->outstanding = 1;
    if (send(link->socket, request, REQUEST, MSG_NOSIGNAL) != REQUEST) fail("a write failed: %s", strerror(errno));
}

/* Takes what has come; whether the reply is complete. */
static int take(struct connection *link, int flags) {
    ssize_t got = recv(link->socket, link->reply + link->kept, (size_t)(REPLY - link->kept), flags);
    if (got == 0) fail("the server closed a connection");
    if (got < 0) {
        if (errno == EAGAIN || errno == EINTR) return 0;
        fail("a read failed: %s", strerror(errno));
    }
    link->kept += (int)got;
    const uint8_t *frame = link->reply;
    if (link->kept >= 9 && frame[7] == 0x83) fail("the server answered with exception %u", frame[8]);
    if (link->kept < REPLY) return 0;
    if ((unsigned)(frame[0] << 8 | frame[1]) != link->identifier) fail("a reply carries a foreign identifier");
    if (frame[2] | frame[3] | frame[4] || frame[5] != REPLY - 6) fail("a reply has a wrong header");
    if (frame[6] != UNIT || frame[7] != 3 || frame[8] != 2 * REGISTERS) fail("a reply does not fit its question");
    link->kept = 0;
    link->outstanding = 0;
    return 1;
}

static void count(uint64_t due, uint64_t at) {
    if (!counted_from || due < counted_from) return;
    uint64_t took = at > due ? at - due : 0;
    if (counted < room) latencies[counted] = (double)took / 1000.0;
    counted++;
    late += took > LATE;
}

static void dial(struct connection *link, const struct addrinfo *address) {
    int on = 1;
    struct timeval patience = {.tv_sec = 5};
    link->socket = socket(address->ai_family, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (link->socket < 0) fail("no socket: %s", strerror(errno));
    if (connect(link->socket, address->ai_addr, address->ai_addrlen)) fail("connect: %s", strerror(errno));
    setsockopt(link->socket, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    setsockopt(link->socket, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    ask(link, 0);
    do errno = 0;
    while (!take(link, 0) && errno != EAGAIN);
    if (link->outstanding) fail("no reply for 5 s on a new connection");
}

static int ascending(const void *left, const void *right) {
    double a = *(const double *)left, b = *(const double *)right;
    return (a > b) - (a < b);
}

static double percentile(double share) {
    return latencies[(uint64_t)(share * (double)(counted - 1))];
}

static double number(const char *text, const char *name, double low, double high) {
    char *end;
    double value = strtod(text, &end);
    if (*end || !(value >= low && value <= high)) fail("%s is %s, allowed are %g…%g", name, text, low, high);
    return value;
}

int main(int argc, char **argv) {
    if (argc != 7) fail("use: paced HOST PORT CONNECTIONS PERIOD SECONDS SERVER");
    size_t connections = (size_t)number(argv[3], "CONNECTIONS", 1, 60000);
    double period = number(argv[4], "PERIOD", 0.001, 3600), seconds = number(argv[5], "SECONDS", 0.01, 3600);
    pid_t server = (pid_t)number(argv[6], "SERVER", 1, 1 << 30);

    struct rlimit files;
    getrlimit(RLIMIT_NOFILE, &files);
    files.rlim_cur = files.rlim_max;
    setrlimit(RLIMIT_NOFILE, &files);

    struct addrinfo wanted = {.ai_socktype = SOCK_STREAM}, *address;
    int problem = getaddrinfo(argv[1], argv[2], &wanted, &address);
    if (problem) fail("%s: %s", argv[1], gai_strerror(problem));
    room = (uint64_t)((double)connections * (seconds / period + 2));
    struct connection *links = calloc(connections, sizeof *links);
    latencies = calloc(room, sizeof *latencies);
    if (!links || !latencies) fail("no memory");
    int poller = epoll_create1(EPOLL_CLOEXEC);
    for (size_t index = 0; index < connections; index++) {
        dial(&links[index], address);
        struct epoll_event event = {.events = EPOLLIN, .data.ptr = &links[index]};
        if (epoll_ctl(poller, EPOLL_CTL_ADD, links[index].socket, &event)) fail("epoll_ctl: %s", strerror(errno));
    }

    double step = period * 1e9 / (double)connections; /* ns between two questions of all clients */
    uint64_t begin = now(), start = begin + (uint64_t)(period * 1e9), stop = start + (uint64_t)(seconds * 1e9);
    double cpu = 0, own = 0;
    uint64_t asked = 0, at = begin, heard = begin;
    struct epoll_event ready[EVENTS];
    while (at < stop) {
        uint64_t due = begin + (uint64_t)((double)asked * step);
        while (due <= at) {
            struct connection *link = &links[asked % connections];
            if (!link->outstanding) ask(link, due);
            else if (due >= start) missing++;
            due = begin + (uint64_t)((double)++asked * step);
        }
        uint64_t pause = due > (at = now()) ? due - at : 0;
        struct timespec patience = {.tv_sec = (time_t)(pause / 1000000000u), .tv_nsec = (long)(pause % 1000000000u)};
        int events = epoll_pwait2(poller, ready, EVENTS, &patience, NULL);
        if (events < 0 && errno != EINTR) fail("epoll_pwait2: %s", strerror(errno));
        at = now();
        for (int index = 0; index < events; index++) {
            struct connection *link = ready[index].data.ptr;
            if (take(link, MSG_DONTWAIT)) {
                count(link->due, at);
                heard = at;
            }
        }
        if (at - heard > 5000000000u) fail("no reply for 5 s");
        if (!counted_from && at >= start) {
            counted_from = at;
            cpu = cpu_of(server);
            own = cpu_of(getpid());
        }
    }
    if (!counted) fail("no transaction was counted");
    if (counted > room) fail("more replies than questions");
    double lasted = (double)(at - counted_from) / 1e9;
    cpu = cpu_of(server) - cpu;
    own = cpu_of(getpid()) - own;
    qsort(latencies, counted, sizeof *latencies, ascending);
    printf("{\"transactions\": %llu, \"seconds\": %.6f, \"rate\": %.1f, \"p50\": %.1f, \"p99\": %.1f, "
           "\"p99.9\": %.1f, \"longest\": %.1f, \"late\": %llu, \"missing\": %llu, \"cpu\": %.6f, \"server\": %.6f}\n",
           (unsigned long long)counted, lasted, (double)counted / lasted, percentile(0.50), percentile(0.99),
           percentile(0.999), latencies[counted - 1], (unsigned long long)late, (unsigned long long)missing, own, cpu);
    return 0;
}
