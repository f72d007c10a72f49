"""Conversations: who may speak when, and what belongs to what. Pure: bytes and ``now`` in, bytes and events out."""
