"""The surfel table: named raw attributes, their activations, initial values and the PLY file."""
