"""The subcommands of `raytwin`, one file each: `add_arguments(parser)` and `run(arguments) -> int`."""
