"""Peak memory of images and their gradients, measured beside what `mi_refgs.memory` says beforehand."""
