"""Prints how a Mambo flies over the field for each drag and delay, as its driver measured it."""

from simulated_mambo import full_speed, measure_and_fly

DRAGS, DELAYS = (0.3, 0.6, 1.0, 2.6, 3.0), (0.0, 0.15, 0.3)


def main():
    print('drag  delay  full_speed m/s  delay s   overshoot  outside  distance  straight  time')
    print('1/s   s      true  measured  measured  m          m        m         m         s')
    for drag in DRAGS:
        for delay in DELAYS:
            flown = measure_and_fly(drag, delay)
            measured = flown.measured
            print(
                f'{drag:<5} {delay:<6} {full_speed(drag):<5.2f} {measured.full_speed:<9.2f} '
                f'{measured.delay:<9.2f} {flown.overshoot:<10.3f} {flown.outside:<8.2f} '
                f'{flown.distance:<9.1f} {flown.straight:<9.1f} {flown.time:.1f}',
                flush=True,
            )


if __name__ == '__main__':
    main()
