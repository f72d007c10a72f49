"""Framings: how a PDU is sent on TCP (``mbap``), and on serial lines (``rtu``, ``rtu_strict``, ``ascii``).

Receivers take bytes and the time of the read and give what was complete (`busway.framing.received.Receiver`); those
of serial lines share what masters, servers and observers need (`busway.framing.received.SerialReceiver`).
"""
