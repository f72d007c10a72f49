/*
 * The floor: the least work a Modbus TCP server can do on this machine.
 *
 * For: a figure in every table that shows how far the others are from the limit. It answers FC03 from a fixed table,
 * takes any other function for a write of 12 bytes that is echoed, works through everything one read brought and sends
 * all replies with one write. It knows the position of five fields and nothing else. Compiled with -DTLS it speaks TLS.
 * Must not: be used as a server. It checks neither protocol, function, limits nor unit, and that is the point.
 *
 * Rules:
 * 1. One epoll loop, one thread, level triggered; one read and one write per wake-up of a connection.
 * 2. A reply that the socket does not take at once is waited for (poll), as a load generator always reads.
 * 3. "port N" on stdout once it listens; "cpu S" (seconds, user + system) on SIGUSR1 and before it ends by SIGTERM.
 * 4. TLS: a handshake blocks all others, as do reads and writes; one SSL_read per wake-up takes one record.
 *
 * Use: floor_server [port] [host]      port 0 (the default) takes a free one; host 127.0.0.1
 *      floor_tls CERTIFICATE KEY AUTHORITY
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/resource.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <unistd.h>
#ifdef TLS
#include <openssl/ssl.h>
#endif

enum {
    HEADER = 7,                       /* transaction 2, protocol 2, length 2, unit 1 */
    REQUEST = HEADER + 5,             /* function 1, address 2, count 2 */
    LONGEST_REPLY = HEADER + 2 + 510, /* an unchecked count may ask for 255 registers at most: only its low byte is used */
    READ_SIZE = 65536,
    EVENTS = 512,
};

struct connection {
    int socket;
#ifdef TLS
    SSL *secure;
#endif
    int kept; /* bytes of an unfinished frame from the read before */
    uint8_t rest[REQUEST];
};

static uint8_t table[2 * 65536 + 512]; /* every register, and room past the last for a read that begins there */
static uint8_t incoming[REQUEST + READ_SIZE];
static uint8_t outgoing[(READ_SIZE / REQUEST + 2) * LONGEST_REPLY];

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
    int listener = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (listener < 0 || inet_pton(AF_INET, host, &address.sin_addr) != 1) die("address");
    setsockopt(listener, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
    if (bind(listener, (struct sockaddr *)&address, size) || listen(listener, 4096)) die("listen");
    getsockname(listener, (struct sockaddr *)&address, &size);
    printf("port %d\n", ntohs(address.sin_port));
    fflush(stdout);
    return listener;
}

static int send_all(struct connection *peer, const uint8_t *bytes, size_t size) {
#ifdef TLS
    return SSL_write(peer->secure, bytes, (int)size) == (int)size ? 0 : -1;
#else
    while (size > 0) {
        ssize_t sent = send(peer->socket, bytes, size, MSG_NOSIGNAL);
        if (sent > 0) {
            bytes += sent;
            size -= (size_t)sent;
        } else if (errno == EAGAIN) {
            struct pollfd writable = {.fd = peer->socket, .events = POLLOUT};
            if (poll(&writable, 1, 5000) <= 0) return -1;
        } else if (errno != EINTR) {
            return -1;
        }
    }
    return 0;
#endif
}

static ssize_t receive(struct connection *peer, uint8_t *bytes) {
#ifdef TLS
    return SSL_read(peer->secure, bytes, READ_SIZE);
#else
    return recv(peer->socket, bytes, READ_SIZE, 0);
#endif
}

/* Answers one readable connection; -1 when it is over. */
static int serve(struct connection *peer) {
    memcpy(incoming, peer->rest, (size_t)peer->kept);
    ssize_t got = receive(peer, incoming + peer->kept);
    if (got <= 0) return got < 0 && (errno == EAGAIN || errno == EINTR) ? 0 : -1;
    size_t size = (size_t)(peer->kept + got), at = 0;
    uint8_t *reply = outgoing;
    for (; size - at >= REQUEST; at += REQUEST) {
        const uint8_t *request = incoming + at;
        if (request[7] != 3) {
            memcpy(reply, request, REQUEST);
            reply += REQUEST;
            continue;
        }
        unsigned address = (unsigned)(request[8] << 8 | request[9]);
        unsigned bytes = 2u * request[11];
        unsigned length = 3 + bytes;
        memcpy(reply, request, 4);
        reply[4] = (uint8_t)(length >> 8);
        reply[5] = (uint8_t)length;
        reply[6] = request[6];
        reply[7] = request[7];
        reply[8] = (uint8_t)bytes;
        memcpy(reply + 9, table + 2 * address, bytes);
        reply += 9 + bytes;
    }
    peer->kept = (int)(size - at);
    memcpy(peer->rest, incoming + at, (size_t)peer->kept);
    return reply == outgoing ? 0 : send_all(peer, outgoing, (size_t)(reply - outgoing));
}

#ifdef TLS
static SSL_CTX *credentials;

static void agree_on_credentials(const char *certificate, const char *key, const char *authority) {
    credentials = SSL_CTX_new(TLS_server_method());
    if (!credentials || SSL_CTX_use_certificate_chain_file(credentials, certificate) != 1 ||
        SSL_CTX_use_PrivateKey_file(credentials, key, SSL_FILETYPE_PEM) != 1 ||
        SSL_CTX_load_verify_locations(credentials, authority, NULL) != 1)
        die("the certificate, the key or the authority cannot be used");
    SSL_CTX_set_verify(credentials, SSL_VERIFY_PEER | SSL_VERIFY_FAIL_IF_NO_PEER_CERT, NULL);
    SSL_CTX_set_session_id_context(credentials, (const unsigned char *)"floor", 5);
}

static SSL *shake_hands(int socket) {
    SSL *secure = SSL_new(credentials);
    fcntl(socket, F_SETFL, fcntl(socket, F_GETFL) & ~O_NONBLOCK);
    if (!secure || SSL_set_fd(secure, socket) != 1 || SSL_accept(secure) != 1) die("no agreement on TLS");
    return secure;
}
#endif

static void accept_all(int listener, int poller) {
    for (;;) {
        int on = 1;
        int socket = accept4(listener, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC);
        if (socket < 0) return;
        setsockopt(socket, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
        struct connection *peer = calloc(1, sizeof *peer);
        if (!peer) die("memory");
        peer->socket = socket;
#ifdef TLS
        peer->secure = shake_hands(socket);
#endif
        struct epoll_event event = {.events = EPOLLIN, .data.ptr = peer};
        if (epoll_ctl(poller, EPOLL_CTL_ADD, socket, &event)) die("epoll_ctl");
    }
}

int main(int argc, char **argv) {
    struct rlimit files;
    getrlimit(RLIMIT_NOFILE, &files);
    files.rlim_cur = files.rlim_max;
    setrlimit(RLIMIT_NOFILE, &files);
    for (size_t item = 0; item < sizeof table / 2; item++) { /* register n holds n, as every server of the bench */
        table[2 * item] = (uint8_t)(item >> 8);
        table[2 * item + 1] = (uint8_t)item;
    }

    sigset_t wanted;
    sigemptyset(&wanted);
    sigaddset(&wanted, SIGTERM);
    sigaddset(&wanted, SIGINT);
    sigaddset(&wanted, SIGUSR1);
    sigprocmask(SIG_BLOCK, &wanted, NULL);

    int poller = epoll_create1(EPOLL_CLOEXEC);
    int signals = signalfd(-1, &wanted, SFD_NONBLOCK | SFD_CLOEXEC);
#ifdef TLS
    if (argc != 4) die("use: floor_tls CERTIFICATE KEY AUTHORITY");
    signal(SIGPIPE, SIG_IGN);
    agree_on_credentials(argv[1], argv[2], argv[3]);
    int listener = listen_at("127.0.0.1", 0);
#else
    int listener = listen_at(argc > 2 ? argv[2] : "127.0.0.1", argc > 1 ? atoi(argv[1]) : 0);
#endif
    struct epoll_event event = {.events = EPOLLIN, .data.ptr = &listener};
    if (epoll_ctl(poller, EPOLL_CTL_ADD, listener, &event)) die("epoll_ctl");
    event.data.ptr = &signals;
    if (epoll_ctl(poller, EPOLL_CTL_ADD, signals, &event)) die("epoll_ctl");

    struct epoll_event ready[EVENTS];
    for (;;) {
        int count = epoll_wait(poller, ready, EVENTS, -1);
        for (int index = 0; index < count; index++) {
            if (ready[index].data.ptr == &listener) {
                accept_all(listener, poller);
            } else if (ready[index].data.ptr == &signals) {
                struct signalfd_siginfo what;
                if (read(signals, &what, sizeof what) != sizeof what) continue;
                print_cpu();
                if (what.ssi_signo != SIGUSR1) return 0;
            } else {
                struct connection *peer = ready[index].data.ptr;
                if (serve(peer)) {
#ifdef TLS
                    SSL_free(peer->secure);
#endif
                    close(peer->socket);
                    free(peer);
                }
            }
        }
    }
}
