/* libmodbus as the master of a serial line whose slave answers late at times; see bench/late_replies.py.
 *
 * late_reads PATH READS TIMEOUT: prints a line of JSON for each read: when it began and ended (seconds, monotonic),
 * the address, the two values or null, what went wrong. */
#include <errno.h>
#include <modbus.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { UNIT = 1, ADDRESSES = 10, BAUD = 19200 };

static double now(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec + time.tv_nsec / 1e9;
}

int main(int argc, char **argv)
{
    if (argc != 4) {
        fprintf(stderr, "late_reads PATH READS TIMEOUT\n");
        return 2;
    }
    double timeout = atof(argv[3]);
    modbus_t *line = modbus_new_rtu(argv[1], BAUD, 'N', 8, 1);
    if (line == NULL || modbus_set_slave(line, UNIT) != 0 || modbus_connect(line) != 0) {
        fprintf(stderr, "%s: %s\n", argv[1], modbus_strerror(errno));
        return 1;
    }
    modbus_set_response_timeout(line, (uint32_t)timeout, (uint32_t)((timeout - (uint32_t)timeout) * 1e6));
    for (int number = 0; number < atoi(argv[2]); number++) {
        uint16_t values[2];
        int address = number % ADDRESSES;
        double began = now();
        int count = modbus_read_registers(line, address, 2, values);
        if (count == 2)
            printf("[%.6f, %.6f, %d, [%d, %d], \"\"]\n", began, now(), address, values[0], values[1]);
        else
            printf("[%.6f, %.6f, %d, null, \"%s\"]\n", began, now(), address, modbus_strerror(errno));
    }
    modbus_close(line);
    modbus_free(line);
    return 0;
}
