"""Peak memory of images and their gradients, compared with the prediction of `mi_refgs.kernels.memory`."""
