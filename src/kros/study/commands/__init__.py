"""What the commands of `kros` beside `kros run` do, one file each."""
