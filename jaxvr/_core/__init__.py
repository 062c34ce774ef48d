"""What every other room stands on: pytrees, checks of arguments, stages, status bits.

No idea of rendering.
"""
