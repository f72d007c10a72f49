"""Certificates: what one says (`facts`), and making those of a test installation (`authority`).

Needs the package ``cryptography``, which is loaded when something of it is used.
"""
