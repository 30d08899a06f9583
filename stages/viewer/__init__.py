"""``lightmill view``: one viewer in the browser for everything in a store, of all systems.

``server`` answers a browser on this machine, ``pages`` says what of a store it may see, ``general`` shows what the names of
members and files tell, ``page/`` is what the browser runs. Systems add their own views (``System.views``); no module here
names a system or a stage.
"""
