"""What a folder of unknown recordings holds, as a mapping that people can correct: the first half of `kros init`."""
