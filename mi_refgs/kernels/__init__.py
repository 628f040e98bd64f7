"""What kernels share: table rows, device arrays, timing, memory."""
