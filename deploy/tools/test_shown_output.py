#!/usr/bin/env python3
"""Tests of the comparison of shown outputs with printed ones."""

import unittest

from shown_output import differences

TABLE = """
method  AP@0.5  AP@0.5 all  latency ms   bytes
none     0.832       0.832     20 / 26       -
late     0.954       0.916     21 / 28  1.4 kB
"""


class ShownOutput(unittest.TestCase):
    def test_numbers_are_compared_but_those_of_time_and_speed(self):
        shown = "a.pcd: x 227.90, 12 inliers\ntook 3.1 s, 40 frames/s, 12 %"
        self.assertEqual(differences(shown, shown.replace("3.1", "12").replace("40", "7"), False), [])
        self.assertEqual(differences(shown, shown.replace("227", "228"), False), ["not printed: a.pcd: x 227.90, 12 inliers"])

    def test_points_stand_for_a_part_of_a_word_and_other_lines_may_lie_between(self):
        self.assertEqual(differences("drive/.../60.pcd: found\nend", "begin\ndrive/a/b/60.pcd: found\nmore\nend\n", False), [])

    def test_a_shorter_run_has_the_same_form_and_may_have_fewer_rows(self):
        printed = "method AP@0.5 AP@0.5 all latency ms bytes\nnone 0.1 0.2 1 / 2 -\n"
        self.assertEqual(differences(TABLE, printed, True), [])
        self.assertEqual(differences(TABLE, printed.replace("AP@0.5 all", "AP@0.7"), True),
                         ["not printed: method AP@0.5 AP@0.5 all latency ms bytes"])
        self.assertEqual(differences(TABLE, "nothing", True), ["none of the lines that are shown is printed"])


if __name__ == "__main__":
    unittest.main()
