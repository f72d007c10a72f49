"""One epoll object for all connections of an event loop, to save CPU.

Without this folder asyncio's transports are used.
"""
