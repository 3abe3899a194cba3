"""Mosaics: of two pictures, of many, and of a stream as it comes.

registering   two pictures -> Link (gated mapping with its evidence)
adjustment    Links -> one world for all pictures or keyframes (flat scenes)
canvas        sparse tiles that grow as frames are painted in
"""
