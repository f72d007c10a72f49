"""The Modbus client: links, the pools that share them, and the asynchronous and the blocking interface.

Where it is decided: how a large read is split: `operations`. Many reads in one call: `read_many`. Who shares a link:
`registry`. How it is opened: `connector`, `serial_connector`, `tls_connector`. Late replies beyond the end of a link:
`kept_late_replies`. Retries, unknown outcomes of writes and reconnecting: `busway.session`.
"""
