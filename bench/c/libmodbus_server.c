/*
 * A libmodbus TCP server for many connections, as fast as libmodbus' public interface allows.
 *
 * For: the peer that the ratios of the server table are about. One epoll loop; for every ready connection
 * modbus_receive and modbus_reply on one context whose socket is switched (what libmodbus' own examples do with
 * select). libmodbus reads and answers one frame per call; joining several into one write is not in its interface.
 *
 * Rules:
 * 1. TCP_NODELAY on each connection, as on all servers of the bench.
 * 2. Register n holds n, unit is not looked at.
 * 3. "port N" on stdout once it listens; "cpu S" (seconds, user + system) on SIGUSR1 and before it ends by SIGTERM.
 *
 * Use: libmodbus_server [port] [host]
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/resource.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <unistd.h>

enum { EVENTS = 512, ITEMS = 65536 };

static void die(const char *what) {
    perror(what);
    exit(1);
}

static void print_cpu(void) {
    struct rusage used;
    getrusage(RUSAGE_SELF, &used);
    printf("cpu %.6f\n", used.ru_utime.tv_sec + used.ru_stime.tv_sec +
                             (used.ru_utime.tv_usec + used.ru_stime.tv_usec) / 1e6);
    fflush(stdout);
}

static int listen_at(const char *host, int port) {
    int on = 1;
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
    socklen_t size = sizeof address;
    int listener = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (listener < 0 || inet_pton(AF_INET, host, &address.sin_addr) != 1) die("address");
    setsockopt(listener, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
    if (bind(listener, (struct sockaddr *)&address, size) || listen(listener, 4096)) die("listen");
    getsockname(listener, (struct sockaddr *)&address, &size);
    printf("port %d\n", ntohs(address.sin_port));
    fflush(stdout);
    return listener;
}

int main(int argc, char **argv) {
    struct rlimit files;
    getrlimit(RLIMIT_NOFILE, &files);
    files.rlim_cur = files.rlim_max;
    setrlimit(RLIMIT_NOFILE, &files);

    modbus_t *context = modbus_new_tcp("127.0.0.1", 0);
    modbus_mapping_t *mapping = modbus_mapping_new(ITEMS, ITEMS, ITEMS, ITEMS);
    if (!context || !mapping) die("libmodbus");
    for (int item = 0; item < ITEMS; item++) mapping->tab_registers[item] = (uint16_t)item;

    sigset_t wanted;
    sigemptyset(&wanted);
    sigaddset(&wanted, SIGTERM);
    sigaddset(&wanted, SIGINT);
    sigaddset(&wanted, SIGUSR1);
    sigprocmask(SIG_BLOCK, &wanted, NULL);
    signal(SIGPIPE, SIG_IGN);

    int poller = epoll_create1(EPOLL_CLOEXEC);
    int signals = signalfd(-1, &wanted, SFD_NONBLOCK | SFD_CLOEXEC);
    int listener = listen_at(argc > 2 ? argv[2] : "127.0.0.1", argc > 1 ? atoi(argv[1]) : 0);
    struct epoll_event event = {.events = EPOLLIN, .data.fd = listener};
    if (epoll_ctl(poller, EPOLL_CTL_ADD, listener, &event)) die("epoll_ctl");
    event.data.fd = signals;
    if (epoll_ctl(poller, EPOLL_CTL_ADD, signals, &event)) die("epoll_ctl");

    struct epoll_event ready[EVENTS];
    uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
    for (;;) {
        int count = epoll_wait(poller, ready, EVENTS, -1);
        for (int index = 0; index < count; index++) {
            int socket = ready[index].data.fd;
            if (socket == listener) {
                int on = 1;
                int accepted = accept4(listener, NULL, NULL, SOCK_CLOEXEC);
                if (accepted < 0) continue;
                setsockopt(accepted, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
                event.data.fd = accepted;
                if (epoll_ctl(poller, EPOLL_CTL_ADD, accepted, &event)) die("epoll_ctl");
            } else if (socket == signals) {
                struct signalfd_siginfo what;
                if (read(signals, &what, sizeof what) != sizeof what) continue;
                print_cpu();
                if (what.ssi_signo != SIGUSR1) return 0;
            } else {
                modbus_set_socket(context, socket);
                int size = modbus_receive(context, request);
                if (size > 0) size = modbus_reply(context, request, size, mapping);
                if (size < 0) close(socket);
            }
        }
    }
}
