"""The subcommands of ``atmo-jit``: one module each, with a click command named ``command``."""
