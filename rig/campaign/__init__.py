"""A day of sessions: many sensors and indenters, one after the other, resumed whenever it stops."""
