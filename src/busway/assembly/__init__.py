"""Components put together from one configuration: server, listeners, links, policy (Messaging on TCP/IP V1.0b §4).

==================  ===================================================================
`configuration`     `load_configuration`, and the object it gives
`judging`           what the components themselves say about the values of a file
`links`             the options of a named link
`certificates`      those of a listener, as they hold in the end
`examining`         what can be said before anything runs
`overview`          what a configuration says, in lines for people
`effective`         every value that holds, as a file
`access`            who may do what while a server runs: rules that can be replaced
`service`           a server with all around it, and how its files are read again
`paths`, `reading`  files by their names
==================  ===================================================================

The shape of the file is known by `busway.config.files.system`.
"""
