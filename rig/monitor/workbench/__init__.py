"""The workbench: a page of the finished sessions, the campaigns and the set-up of a lab."""
