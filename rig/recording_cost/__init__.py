"""What recording costs on this machine, beside what others' stores cost: `docs/recording.md`."""
