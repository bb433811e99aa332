"""The flying test bed: an aircraft, its sensors and its autopilot behind a MAVLink front.

`flight.Flight` is all of it without a socket and without a clock: an iterator of (time_us, bytes) and `take(bytes)` for
what comes in, so that an engine can be driven in lock-step; `front` puts sockets around it. The modules, from the truth
outwards:

    settings    what is flown
    aircraft    JSBSim's Cessna 172            course      where it goes and how high above the ground
    autopilot   the loops that steer it        senses      GNSS, altimeter, barometer, and the ground they see
    inertial    the errors of the INS          fusion      the filter in the vehicle, which takes GNSS and fixes
    flight      all of it, tick by tick        score       how far off it was
    telemetry   MAVLink messages out           inbox       what comes in: fixes, requests, commands
    front       sockets and the pace           records     truth and telemetry in files
"""
