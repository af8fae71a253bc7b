"""The experiments of the paper as data, with the code that runs and reports them; the program is `reproduce`.

`definitions` reads the JSON files in this folder, `planning` turns an experiment into jobs and tracks their progress, `report`
writes figures and tables, `stepping` measures the speed of an environment.
"""
