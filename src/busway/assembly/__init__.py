"""Components put together from one configuration: server, listeners, links, policy (Messaging on TCP/IP V1.0b §4).

==================  ===================================================================
`configuration`     `load_configuration`, and the object it gives
`judging`           what the components themselves say about the values of a file
`links`             the options of a named link
`overview`          what a configuration says, in lines for people
==================  ===================================================================

The shape of the file is known by `busway.config.files.system`.
"""
