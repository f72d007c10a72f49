"""Framings: how a PDU is sent on TCP (``mbap``), and on serial lines (``rtu``, ``rtu_strict``, ``ascii``).

=================  =====================================================================================================
`ascii`            ASCII framing: between a colon and the end delimiter, two characters for each byte
`byte_times`       Estimates when each received byte was on the serial line, from the times at which bytes were read
`character_times`  Times on a serial line: characters, t1.5, t3.5 and whole frames
`crc`              CRC-16 of RTU frames
`datagram`         Checks whether a datagram is exactly one whole frame
`echo`             Removes the echo of a two-wire serial line: a station first receives the bytes that it sent itself
`frame_direction`  Tells whether the next frame on a shared serial line, heard by any station, is a request or a reply
`lengths`          Lengths of RTU frames by function code, prepared so that one look-up gives the length of a frame
`lost`             Collects bytes on a serial line that are no frame, until the disturbance ends
`lrc`              LRC of ASCII frames
`mbap`             MBAP framing: the seven-byte header before a PDU on TCP
`received`         What receivers of serial lines return (frames, damaged bytes)
`rtu`              RTU receiver that tolerates gaps inside frames: finds their ends by length and CRC
`rtu_search`       Search for the next frame inside damaged RTU bytes: the only work that grows with the noise on a line
`rtu_strict`       Strict RTU receiver, of the option `strict_timing`: a gap above t1.5 spoils a frame
=================  =====================================================================================================

A receiver takes bytes with the time at which they were read, and returns the frames that they complete
(`busway.framing.received.Receiver`). Those of serial lines have further methods, for masters, servers and observers
(`busway.framing.received.SerialReceiver`).

Where it is decided: where a frame ends: `lengths` by function, `rtu` by length and CRC, `rtu_strict` by silence
(``strict_timing``), `ascii` by its delimiter (``delimiter``, ``character_timeout``), `mbap` by its header; whether a
datagram is a frame: `datagram`. How long an unfinished RTU frame waits for its rest, such as after a pause of a USB
adapter (``gap_limit``): `rtu`. Whether a next frame is looked for after damaged bytes, and for how long: `rtu`; where
it begins: `rtu_search`. Whether a frame is a request or a reply: `frame_direction`. Whether received bytes are an echo
(``echo``): `echo`. How long t1.5 and t3.5 are: `character_times`; when a byte was on the line: `byte_times`.
"""
