"""Largest inputs that are read: a device, an archive that unpacks to terabytes or a broken file ends in a message.

They are far above what recordings and studies need. Readers look them up when they read, so a program that needs more
assigns here: ``kros.core.limits.MAX_TEXT_BYTES = 1 << 36``.
"""

MAX_JSON_BYTES = 1 << 29  # an index of a million episodes takes some 30 MB
MAX_TOML_BYTES = 1 << 22
MAX_ARRAYS_BYTES = 1 << 33  # of one .npz
MAX_TEXT_BYTES = 1 << 32  # of one recording as text, unpacked
MAX_SAMPLES = 10**8  # of one episode
MAX_VALUE = 1e50  # of a sample, a time, a sampling period and its inverse: products of six are finite
