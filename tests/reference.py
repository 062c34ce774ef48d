"""The brute force under the name that tests know: see `jaxvr.testing.brute`."""

from jaxvr.testing.brute import AROUND, BruteForce

Reference = BruteForce
__all__ = ["AROUND", "Reference"]
