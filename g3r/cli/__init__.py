"""The commands: one thin file each. They parse, call, print, and turn errors into exit codes."""
