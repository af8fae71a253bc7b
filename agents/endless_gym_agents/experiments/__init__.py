"""The experiments of the paper as data, and what runs and reports them; the program is `endless_gym_agents.reproduce`.

`definitions` reads the JSON files of this folder, `planning` turns an experiment into commands and says what is done, `running`
runs the commands side by side, `report` writes figures and tables, `stepping` measures the speed of an environment.
"""
