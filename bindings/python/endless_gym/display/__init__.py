"""What people see and press: rendered views, the window, keys, and the meanings of numbers."""
