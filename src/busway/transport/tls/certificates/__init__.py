"""Certificates: reading what one says (`facts`), and issuing those of a test installation (`authority`).

Needs the package ``cryptography``, which is loaded when something of it is used.
"""
