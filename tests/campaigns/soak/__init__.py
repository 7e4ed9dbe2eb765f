"""Endurance: the whole daemon on the fakes for hours, with memory, tasks, threads and files watched."""
