"""What is affordable: settings by name, time budgets, and memory stated before it is taken."""
