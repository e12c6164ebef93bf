"""The commands, one thin file each: they parse, call, print, and turn errors into exit codes."""
