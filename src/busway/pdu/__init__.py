"""Messages: one class for each Modbus function, and the table that lists them. Start reading at ``read_items``.

====================  ==============================================================================================
`bits`                Packing of bits on the wire: eight to a byte, the first item in the lowest bit
`compiler`            Makes constructor, encoder and decoder of a message class from its declared fields, once
`describe`            Describes a PDU for people: every field with its offset, its value and its fault, if any
`device_interface`    Interfaces of a device through which a request reads and writes it (`Request.apply`)
`diagnostics`         Messages of functions 07, 08, 11, 12 and 17: status and identification of a server
`encapsulated`        Function 43, Encapsulated Interface Transport: device identification (14) and CANopen (13)
`exception_response`  The exception reply of any function, and its decoder
`fast_answers`        The server's fast path: functions from request bytes to reply bytes, without message objects
`fields`              The kinds of fields with which the messages of every function are declared
`file_records`        Messages of functions 20 and 21, which read and write records of files, in several groups
`functions`           The table of functions: which request and reply class belongs to a function code
`malformed_pdu`       The error for a received message that breaks a rule of its function, with its exception code
`malformed_request`   A received request that breaks a rule of its function: its bytes, the rule, the exception code
`message`             Base classes of request and reply messages: fields are declared
`read_items`          Messages of functions 01–04 and 24, which read the four tables and a queue of registers
`server_id`           The data of function 17 in its parts: identification, run indicator, the rest
`unknown_functions`   Requests and replies of functions that are not in the table of functions, kept as bytes
`wide_registers`      Requests for registers wider than two bytes, of devices that answer 4…12 bytes for each
`write_items`         Messages of functions 05, 06, 15, 16, 22 and 23, which write coils and holding registers
====================  ==============================================================================================

Where it is decided: which class belongs to a function code: `functions`. Whether a message is valid, and which values
its fields take: its class, in the file of its function, with `fields`; the checks themselves are compiled by
`compiler`. Which exception code an invalid request gets: `malformed_pdu`, where 03 is the default. Whether a reply
answers its request: `message` (``Request.accept``, with ``check_reply`` of the function's class); how long that reply
is and how it begins: ``reply_shape`` of the class. Where an RTU frame ends by its function: `functions`
(``request_length``, ``reply_length``). Which requests the server's fast path answers: `fast_answers`. How registers
wider than two bytes are read (``register_width``): `wide_registers`. In which order a request reads and writes the
device: its ``apply``, by the interfaces of `device_interface`. What a trace shows of a message: `describe`.
"""
