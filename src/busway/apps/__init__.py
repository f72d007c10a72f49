"""Applications: what is built on the library. The library does not import them."""
