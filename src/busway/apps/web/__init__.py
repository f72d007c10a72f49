"""The page of a simulation, of a collector or of a fleet: one application with modules, its API and one WebSocket.

=====================  =================================================================================================
`hosting`              Serves a web page and its HTTP API on one address, in the running event loop
`application`          The one application of all pages: shell, modules of the program, files, and the caller's role
`request_guard`        Access control of a web page: host, origin, caller and size of every request
`connections`          Limits the connections of a page: their number, and the times for requests and messages
`api_application`      The FastAPI application of a page's API: how errors are answered, and its OpenAPI document
`messages`             Base classes for requests and responses of all pages, errors, and values as JSON
`viewers`              The WebSockets of open pages: how a viewer is accepted, served and closed
`simulation_page`      The web page of a simulation: its module, and the page that shows it
`simulation_messages`  Requests and responses of a simulation's HTTP API, as data classes
`simulation_api`       The HTTP API of a simulation's page: points, faults, connections, traffic
`simulation_stream`    `/stream` of a simulation's page: a WebSocket that sends changes to viewers as JSON texts
`simulation_traffic`   Keeps the latest Modbus frames of a simulation for its page; they are explained only when shown
`simulation_subject`   The interface of a simulation, as its page and HTTP API use it
`collector_page`       The web page of a collector, and the HTTP API below it
`collector_messages`   Responses of the HTTP API of a collector's page, as data classes
`collector_commands`   Commands and the configuration over the HTTP API of a collector's page
`collector_stream`     `/stream` of a collector's page: a WebSocket with changed values, alarms and commands
`collector_log`        The latest log messages of a collector, for its page: records of all loggers of busway
`live_values`          Last committed values of all points, and the changes since a tick, for all viewers
`fleet_page`           The fleet on the page of one of its collectors, and over HTTP
`page`                 HTML, style and scripts: the shell, and the modules `simulation`, `collector` and `fleet`
`simulation_faults`    Faults of a simulation as its HTTP API shows and changes them
`access_tokens`        The file with the access tokens of a page: created at the first start, for its owner alone
`collector_alarms`     The alarms of a collector and the maintenance of its devices, over HTTP
=====================  =================================================================================================

1. This package needs the extra ``web``, and is imported only when a page is started.
2. There is one shell, one navigation, one rule of access and one set of files; a program adds its modules to them.
3. A page runs in the event loop of its simulation or collector, so it never reads a state that is half changed.

Where it is decided: who may call, with which role, from which host and origin (``tokens``, ``subjects``):
`request_guard`. How many connections there may be, and how long each may wait: `connections`. Which tokens are valid:
`access_tokens`. How an error is answered: `api_application`. Which changes a viewer of a collector is sent, and when:
`live_values`, `collector_stream`; a viewer of a simulation: `simulation_stream`. Which values are shown as bad or held
while a device is not read: `live_values`. How long a viewer may take for a message, and whether its token is still
valid: `viewers`. Which files and modules a page has: `application`. What a command from the page needs:
`collector_commands`.
"""
