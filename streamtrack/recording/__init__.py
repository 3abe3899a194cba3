"""Recordings for the Rerun viewer and the live view; nothing else in streamtrack talks to Rerun.

`recorder.Recorder` writes a run's recording, `live_view.LiveView` shows it as it goes; both log
through `steps`. `entities` names what a recording is made of, `styles` says how that is drawn,
`blueprint` lays the viewer out; `series` and `repair` look after recordings in parts, `pictures`
records mosaics of pictures.
"""
