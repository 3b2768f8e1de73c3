"""What helps to write policy: its cases and how well they hold it, its meaning in words."""
