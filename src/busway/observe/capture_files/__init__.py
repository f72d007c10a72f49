"""Reads capture files: packets of a file, what they carry, streams of bytes, and the Modbus frames in them.

==================  ====================================================================================================
`packet_file`       Reads the packets of a pcap or pcapng file, one by one
`layers`            Takes a packet apart: link layer, IP, TCP or UDP, or the bytes of a serial line
`tcp_reassembly`    Puts the segments of one direction of a TCP connection in order, and says which bytes are missing
`frame_extraction`  Finds the Modbus frames in the packets of a capture file, connection by connection
==================  ====================================================================================================

Where it is decided: which formats and link types are read: `packet_file`, `layers`. What happens where bytes are
missing: `tcp_reassembly`. Which port has Modbus, and who is client and who is server: `frame_extraction`.
"""
