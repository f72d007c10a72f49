"""Frames: how a PDU travels on TCP (``mbap``), and on serial lines."""
