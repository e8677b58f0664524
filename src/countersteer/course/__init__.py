"""Courses: walls, centre line, start and goal."""
