"""Gradient updates faster than autograd's.

`compiled` is the update on a CPU, its mathematics included, `update` what hands a module's networks
to it, `blas` the library that multiplies matrices there. Updates on a GPU are autograd's.
"""
