"""The surfel table: named raw channels, their activations, initial values and the PLY file."""
