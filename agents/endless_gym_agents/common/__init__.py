"""What every room uses: files, ranges of settings, command lines, tables."""
