/*
 * A Modbus client made of libmodbus, for the interop tests.
 *
 *   libmodbus_client tcp HOST PORT UNIT
 *   libmodbus_client rtu DEVICE BAUD PARITY UNIT
 *
 * Prints "ready" once it is connected, then reads one command per line and prints one line of JSON for each:
 *   {"ok": true, …}   or   {"ok": false, "exception": CODE or 0, "error": "…"}
 *
 *   read_coils ADDRESS COUNT                 read_discrete_inputs ADDRESS COUNT
 *   read_holding_registers ADDRESS COUNT     read_input_registers ADDRESS COUNT
 *   write_single_coil ADDRESS 0|1            write_single_register ADDRESS VALUE
 *   write_multiple_coils ADDRESS BIT…        write_multiple_registers ADDRESS VALUE…
 *   mask_write_register ADDRESS AND OR       report_server_id
 *   read_write_multiple_registers READ_ADDRESS READ_COUNT WRITE_ADDRESS VALUE…
 *   unit UNIT                                raw FUNCTION BYTE…  (the reply as the hexadecimal bytes of its PDU)
 *
 * Numbers are decimal, or hexadecimal with 0x.
 */

#include <errno.h>
#include <modbus/modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MOST_NUMBERS = 2100, LONGEST_LINE = 16384 };

static void print_failure(void)
{
    int code = errno > MODBUS_ENOBASE && errno < MODBUS_ENOBASE + MODBUS_EXCEPTION_MAX ? errno - MODBUS_ENOBASE : 0;
    printf("{\"ok\": false, \"exception\": %d, \"error\": \"%s\"}\n", code, modbus_strerror(errno));
}

static void print_done(int result)
{
    if (result < 0) {
        print_failure();
    } else {
        printf("{\"ok\": true}\n");
    }
}

static void print_bits(int result, const uint8_t *bits)
{
    if (result < 0) {
        print_failure();
        return;
    }
    printf("{\"ok\": true, \"values\": [");
    for (int index = 0; index < result; index++) {
        printf("%s%s", index ? ", " : "", bits[index] ? "true" : "false");
    }
    printf("]}\n");
}

static void print_registers(int result, const uint16_t *registers)
{
    if (result < 0) {
        print_failure();
        return;
    }
    printf("{\"ok\": true, \"values\": [");
    for (int index = 0; index < result; index++) {
        printf("%s%d", index ? ", " : "", registers[index]);
    }
    printf("]}\n");
}

static void print_bytes(const char *name, const uint8_t *bytes, int length)
{
    printf("{\"ok\": true, \"%s\": \"", name);
    for (int index = 0; index < length; index++) {
        printf("%02x", bytes[index]);
    }
    printf("\"}\n");
}

static void send_raw(modbus_t *context, const int *numbers, int count)
{
    uint8_t request[MODBUS_MAX_ADU_LENGTH];
    uint8_t reply[MODBUS_MAX_ADU_LENGTH];
    request[0] = (uint8_t)modbus_get_slave(context);
    for (int index = 0; index < count; index++) {
        request[index + 1] = (uint8_t)numbers[index];
    }
    int length = modbus_send_raw_request(context, request, count + 1);
    if (length >= 0) {
        length = modbus_receive_confirmation(context, reply);
    }
    if (length < 0) {
        print_failure();
        return;
    }
    int header = modbus_get_header_length(context);
    int checksum = header == 1 ? 2 : 0;
    print_bytes("pdu", reply + header, length - header - checksum);
}

static void execute(modbus_t *context, const char *command, const int *numbers, int count)
{
    static uint8_t bits[MOST_NUMBERS];
    static uint16_t registers[MOST_NUMBERS];
    int first = count > 0 ? numbers[0] : 0;
    int second = count > 1 ? numbers[1] : 0;
    int third = count > 2 ? numbers[2] : 0;

    if (strcmp(command, "read_coils") == 0) {
        print_bits(modbus_read_bits(context, first, second, bits), bits);
    } else if (strcmp(command, "read_discrete_inputs") == 0) {
        print_bits(modbus_read_input_bits(context, first, second, bits), bits);
    } else if (strcmp(command, "read_holding_registers") == 0) {
        print_registers(modbus_read_registers(context, first, second, registers), registers);
    } else if (strcmp(command, "read_input_registers") == 0) {
        print_registers(modbus_read_input_registers(context, first, second, registers), registers);
    } else if (strcmp(command, "write_single_coil") == 0) {
        print_done(modbus_write_bit(context, first, second));
    } else if (strcmp(command, "write_single_register") == 0) {
        print_done(modbus_write_register(context, first, (uint16_t)second));
    } else if (strcmp(command, "write_multiple_coils") == 0) {
        for (int index = 1; index < count; index++) {
            bits[index - 1] = numbers[index] != 0;
        }
        print_done(modbus_write_bits(context, first, count - 1, bits));
    } else if (strcmp(command, "write_multiple_registers") == 0) {
        for (int index = 1; index < count; index++) {
            registers[index - 1] = (uint16_t)numbers[index];
        }
        print_done(modbus_write_registers(context, first, count - 1, registers));
    } else if (strcmp(command, "mask_write_register") == 0) {
        print_done(modbus_mask_write_register(context, first, (uint16_t)second, (uint16_t)third));
    } else if (strcmp(command, "read_write_multiple_registers") == 0) {
        static uint16_t written[MOST_NUMBERS];
        for (int index = 3; index < count; index++) {
            written[index - 3] = (uint16_t)numbers[index];
        }
        print_registers(
            modbus_write_and_read_registers(context, third, count - 3, written, first, second, registers), registers);
    } else if (strcmp(command, "report_server_id") == 0) {
        uint8_t identity[MODBUS_MAX_PDU_LENGTH];
        int length = modbus_report_slave_id(context, sizeof identity, identity);
        if (length < 0) {
            print_failure();
        } else {
            print_bytes("data", identity, length);
        }
    } else if (strcmp(command, "unit") == 0) {
        print_done(modbus_set_slave(context, first));
    } else if (strcmp(command, "raw") == 0) {
        send_raw(context, numbers, count);
    } else {
        printf("{\"ok\": false, \"exception\": 0, \"error\": \"unknown command\"}\n");
    }
}

int main(int count, char **arguments)
{
    modbus_t *context = NULL;
    int unit = 0;
    if (count == 5 && strcmp(arguments[1], "tcp") == 0) {
        context = modbus_new_tcp(arguments[2], atoi(arguments[3]));
        unit = atoi(arguments[4]);
    } else if (count == 6 && strcmp(arguments[1], "rtu") == 0) {
        char parity = arguments[4][0];
        context = modbus_new_rtu(arguments[2], atoi(arguments[3]), parity, 8, parity == 'N' ? 2 : 1);
        unit = atoi(arguments[5]);
    } else {
        fprintf(stderr, "usage: libmodbus_client tcp HOST PORT UNIT | rtu DEVICE BAUD PARITY UNIT\n");
        return 2;
    }
    if (context == NULL || modbus_set_slave(context, unit) < 0 || modbus_connect(context) < 0) {
        fprintf(stderr, "cannot connect: %s\n", modbus_strerror(errno));
        return 1;
    }
    modbus_set_response_timeout(context, 5, 0);
    printf("ready\n");
    fflush(stdout);

    static char line[LONGEST_LINE];
    static int numbers[MOST_NUMBERS];
    while (fgets(line, sizeof line, stdin) != NULL) {
        char *command = strtok(line, " \n");
        if (command == NULL) {
            continue;
        }
        int given = 0;
        for (char *word = strtok(NULL, " \n"); word != NULL && given < MOST_NUMBERS; word = strtok(NULL, " \n")) {
            numbers[given++] = (int)strtol(word, NULL, 0);
        }
        execute(context, command, numbers, given);
        fflush(stdout);
    }
    modbus_close(context);
    modbus_free(context);
    return 0;
}
