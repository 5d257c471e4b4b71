"""The certificate of an observer at run time, retracted and lifted again at every step."""
