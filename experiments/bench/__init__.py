"""Questions of one table each: `python -m experiments bench NAME`. Each is a module with a function `command`, of the same name."""
