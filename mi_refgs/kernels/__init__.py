"""Shared by kernels: packed rows, device arrays, timing, memory."""
