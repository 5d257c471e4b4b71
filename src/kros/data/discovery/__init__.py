"""What a folder of unknown recordings holds: the first half of `kros init`.

Nothing here decides what a study computes: it writes down a mapping that people can correct, and says what it rests on.
"""
