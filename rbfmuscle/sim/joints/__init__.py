"""Joints of any kind: functions of coordinates, one table of kinds, and the poses that they give."""
