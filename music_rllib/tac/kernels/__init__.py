"""One gradient update on a CPU without autograd: kept buffers, derivatives in closed form.

`update` is the update, `derivatives` its mathematics, `network` a perceptron on kept buffers,
`products` the choice of the library that multiplies matrices, `flat` parameters in one tensor.
"""
