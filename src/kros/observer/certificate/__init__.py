"""The certificate of an observer as it runs, retracted and lifted again at every step."""
