"""Inverse kinematics and retargeting."""
