"""Calls that type checkers must refuse: each marked line is an error."""

import endless_gym

endless_gym.make_vec("MysteryPath-v0", autoreset="next step")  # wrong
endless_gym.serve("MysteryPath-v0", autoreset="nextstep")  # wrong
endless_gym.make_vec("MysteryPath-v0", observation="pixels")  # wrong
endless_gym.make_vec("MysteryPath-v0", frames={"stack": 4})  # wrong
endless_gym.Env("MysteryPath-v0", seed=3)  # wrong
endless_gym.connect(3)  # wrong
print(endless_gym.spec("MysteryPath-v0").ground_truth_columns[0].meaning)  # wrong
