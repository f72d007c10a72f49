"""Certificates: reading what one says (`facts`), and issuing those of a test installation (`authority`).

Needs the package ``cryptography``, which is imported at the first use.
"""
