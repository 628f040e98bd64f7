"""A method as data: what the TOML files of `variants/` say."""
