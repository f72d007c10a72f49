"""Messages: one class for each Modbus function, and the table that lists them. Start reading at ``read_items``.

================  ======================================================================================================
`bits`            Packing of bits on the wire: eight to a byte, the first item in the lowest bit
`compiler`        Compiles the declared fields of a message class into its constructor, encoder and decoder, once
`describe`        Describes a PDU for people: every field with its offset, its value and its fault, if any
`diagnostics`     Functions 07, 08, 11, 12 and 17: status and identification of a server
`encapsulated`    Function 43, Encapsulated Interface Transport: device identification (14) and CANopen (13)
`fast_answers`    Fast answers: functions compiled for one device that turn request bytes into reply bytes
`fields`          The kinds of message fields with which every function is declared
`file_records`    Functions 20 and 21: reading and writing records of files, several groups in one request
`functions`       The function table: the message classes that a framer, session or decoder works with, by function code
`general`         Messages of no particular function: exceptions, and requests and replies of unknown functions
`malformed`       The error for a received message that breaks a rule of its function, with the exception code to reply
`message`         Base classes of messages, whose declared fields are compiled once into encoder and decoder
`model`           Interfaces of a device that requests act on when they are executed (`Request.apply`)
`read_items`      Functions 01–04 and 24: reading the four tables and a queue of registers
`wide_registers`  Reads of registers that are wider than two bytes: such a device answers 4…12 bytes for each register
`write_items`     Functions 05, 06, 15, 16, 22 and 23: writing coils and holding registers
================  ======================================================================================================
"""
