/*
 * A Modbus server made of libmodbus, for the interop tests.
 *
 *   libmodbus_server tcp PORT                      127.0.0.1, port 0 takes a free one, any unit
 *   libmodbus_server rtu DEVICE BAUD PARITY UNIT   parity N, E or O
 *
 * Prints "ready PORT" (or "ready DEVICE") when it listens, then serves until it is ended. One thread, one select loop.
 * Four tables of 1000 items with a content that the tests compute too:
 *   holding register a = 7 a + 3     input register a = 11 a + 5     (both modulo 65536)
 *   coil a = a divisible by 3        discrete input a = a divisible by 5
 */

#include <arpa/inet.h>
#include <errno.h>
#include <modbus/modbus.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <unistd.h>

enum { ITEMS = 1000 };

static modbus_mapping_t *known_content(void)
{
    modbus_mapping_t *tables = modbus_mapping_new(ITEMS, ITEMS, ITEMS, ITEMS);
    if (tables == NULL) {
        perror("modbus_mapping_new");
        exit(1);
    }
    for (int address = 0; address < ITEMS; address++) {
        tables->tab_registers[address] = (uint16_t)(address * 7 + 3);
        tables->tab_input_registers[address] = (uint16_t)(address * 11 + 5);
        tables->tab_bits[address] = address % 3 == 0;
        tables->tab_input_bits[address] = address % 5 == 0;
    }
    return tables;
}

/* One request and its reply on the descriptor that the context holds; 0 when the connection is over. */
static int serve_one(modbus_t *context, modbus_mapping_t *tables)
{
    uint8_t request[MODBUS_MAX_ADU_LENGTH];
    int length = modbus_receive(context, request);
    if (length < 0) {
        return 0;
    }
    if (length > 0) { /* 0: a frame for another unit of the line */
        modbus_reply(context, request, length, tables);
    }
    return 1;
}

static int serve_tcp(int port, modbus_mapping_t *tables)
{
    modbus_t *context = modbus_new_tcp("127.0.0.1", port);
    int listener = context == NULL ? -1 : modbus_tcp_listen(context, 16);
    struct sockaddr_in bound;
    socklen_t size = sizeof bound;
    if (listener < 0 || getsockname(listener, (struct sockaddr *)&bound, &size) < 0) {
        fprintf(stderr, "cannot listen on port %d: %s\n", port, modbus_strerror(errno));
        return 1;
    }
    printf("ready %d\n", ntohs(bound.sin_port));
    fflush(stdout);

    fd_set watched;
    FD_ZERO(&watched);
    FD_SET(listener, &watched);
    int highest = listener;
    for (;;) {
        fd_set readable = watched;
        if (select(highest + 1, &readable, NULL, NULL, NULL) < 0) {
            if (errno == EINTR) {
                continue;
            }
            perror("select");
            return 1;
        }
        for (int descriptor = 0; descriptor <= highest; descriptor++) {
            if (!FD_ISSET(descriptor, &readable)) {
                continue;
            }
            if (descriptor == listener) {
                int connection = accept(listener, NULL, NULL);
                if (connection >= 0 && connection < FD_SETSIZE) {
                    FD_SET(connection, &watched);
                    if (connection > highest) {
                        highest = connection;
                    }
                } else if (connection >= 0) {
                    close(connection);
                }
                continue;
            }
            modbus_set_socket(context, descriptor);
            if (!serve_one(context, tables)) {
                close(descriptor);
                FD_CLR(descriptor, &watched);
            }
        }
    }
}

static int serve_rtu(const char *device, int baud, char parity, int unit, modbus_mapping_t *tables)
{
    modbus_t *context = modbus_new_rtu(device, baud, parity, 8, parity == 'N' ? 2 : 1);
    if (context == NULL || modbus_set_slave(context, unit) < 0 || modbus_connect(context) < 0) {
        fprintf(stderr, "cannot open %s: %s\n", device, modbus_strerror(errno));
        return 1;
    }
    printf("ready %s\n", device);
    fflush(stdout);
    for (;;) {
        if (!serve_one(context, tables) && (errno == EIO || errno == EBADF || errno == ENXIO)) {
            fprintf(stderr, "%s is gone: %s\n", device, modbus_strerror(errno));
            return 1;
        }
    }
}

int main(int count, char **arguments)
{
    if (count == 3 && strcmp(arguments[1], "tcp") == 0) {
        return serve_tcp(atoi(arguments[2]), known_content());
    }
    if (count == 6 && strcmp(arguments[1], "rtu") == 0) {
        return serve_rtu(arguments[2], atoi(arguments[3]), arguments[4][0], atoi(arguments[5]), known_content());
    }
    fprintf(stderr, "usage: libmodbus_server tcp PORT | rtu DEVICE BAUD PARITY UNIT\n");
    return 2;
}
