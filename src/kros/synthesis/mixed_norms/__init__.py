"""Mixed H2/H-infinity synthesis.

Inequalities, the solvers that they are given to, and the Youla program as a yardstick.
"""
