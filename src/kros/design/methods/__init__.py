"""The methods of observer design, one file each, and the table of them all."""
