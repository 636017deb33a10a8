"""A long collection on the mock bench, watched from outside: is memory flat, is all there?"""
