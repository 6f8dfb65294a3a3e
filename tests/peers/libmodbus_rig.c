/* A small indentation rig on libmodbus: a peer that shares no code with the driver or with the simulator.
 *
 *   libmodbus_rig tcp PORT | rtu DEVICE
 *
 * Prints "ready" when it listens. A stage at constant speed, a spring of 0.5 N/mm from 8 mm on, and the reference
 * register map: enough for the driver's own tests. One millisecond is one tick.
 */
#include <errno.h>
#include <modbus.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { DISARMED, READY, MOVING, FAULTED };
enum { NONE, RUNNING, DONE, REFUSED, ABORTED };
enum { MOVE = 1, STOP, ARM, DISARM, HOME, CLEAR, UNTIL_ABOVE, UNTIL_BELOW, MOVE_STAGE };

#define SEQUENCE 0
#define COMMAND 100
#define COMMAND_WORDS 13
#define SETTINGS 120
#define FEED 140
#define REGISTERS 160

static modbus_mapping_t *map;
static struct timespec began;
static int state = DISARMED, faults = 0x60, command_state = NONE, reason = 0;
static uint32_t command_id = 0, last_feed = 0, tick = 0;
static double position = 1.5, target = 1.5, speed = 0, until = 0;
static int code = 0;

static uint32_t u32(const uint16_t *w) { return (uint32_t)w[0] << 16 | w[1]; }
static int32_t i32(const uint16_t *w) { return (int32_t)u32(w); }
static void put32(uint16_t *w, uint32_t v) { w[0] = v >> 16; w[1] = v & 0xFFFF; }
static double force(void) { return position > 8 ? 0.5 * (position - 8) : 0; }

static uint32_t now_ms(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (t.tv_sec - began.tv_sec) * 1000 + (t.tv_nsec - began.tv_nsec) / 1000000;
}

static uint16_t check(const uint16_t *w, int n)
{
    uint32_t c = 0xFFFF;
    for (int k = 0; k < n; k++) {
        c ^= w[k];
        for (int b = 0; b < 16; b++)
            c = c & 0x8000 ? (c << 1 ^ 0x1021) & 0xFFFF : c << 1 & 0xFFFF;
    }
    return c;
}

static void end(int how, int why) { command_state = how; reason = why; }

static void fault(int bit)
{
    faults |= bit;
    state = FAULTED;
    if (command_state == RUNNING) end(ABORTED, 0);
}

static void run_on(void)
{
    for (uint32_t goal = now_ms(); tick < goal; tick++) {
        if (state == MOVING) {
            double left = target - position, step = speed / 1000;
            position += left > step ? step : left < -step ? -step : left;
            int above = code == UNTIL_ABOVE && force() >= until, below = code == UNTIL_BELOW && force() <= until;
            if (above || below || position == target) {
                state = READY;
                if (code == HOME) faults &= ~0x60;
                end(DONE, (code == UNTIL_ABOVE || code == UNTIL_BELOW) && !above && !below ? 9 : 0);
            }
        }
        if (state == READY || state == MOVING) {
            double most = i32(map->tab_registers + SETTINGS) * 1e-5;
            if (force() > most) fault(1);
            if (tick - last_feed > map->tab_registers[SETTINGS + 12]) fault(2);
        }
    }
}

static void take_command(void)
{
    const uint16_t *w = map->tab_registers + COMMAND;
    if (u32(w) <= command_id) return;
    command_id = u32(w);
    int asked = w[2];
    double goal = i32(w + 3) * 1e-4, rate = i32(w + 5) * 1e-4;
    command_state = RUNNING;
    reason = 0;
    switch (asked) {
    case STOP: if (state == MOVING) state = READY; end(DONE, 10); return;
    case DISARM: state = DISARMED; end(DONE, 0); return;
    case CLEAR: faults &= 0x60; state = DISARMED; end(DONE, 0); return;
    case ARM:
        if (faults & ~0x60) { end(REFUSED, 2); return; }
        last_feed = tick; state = READY; end(DONE, 0); return;
    case MOVE: case HOME: case UNTIL_ABOVE: case UNTIL_BELOW:
        if (state == FAULTED) { end(REFUSED, 2); return; }
        if (state == DISARMED) { end(REFUSED, 1); return; }
        if (rate <= 0 || rate > 20) { end(REFUSED, 6); return; }
        if (asked == HOME) goal = 0;
        else if (faults & 0x20) { end(REFUSED, 7); return; }
        if (goal < i32(map->tab_registers + SETTINGS + 4) * 1e-4 - 1e-9 ||
            goal > i32(map->tab_registers + SETTINGS + 6) * 1e-4 + 1e-9) { end(REFUSED, 3); return; }
        code = asked; target = goal; speed = rate; until = i32(w + 7) * 1e-5; state = MOVING; return;
    default: end(REFUSED, 4);
    }
}

static void show_status(uint16_t echo)
{
    uint16_t *w = map->tab_registers + SEQUENCE;
    put32(w, tick);
    w[2] = echo;
    w[3] = tick & 0xFFFF;
    w[4] = state;
    w[5] = faults;
    put32(w + 6, command_id);
    w[8] = command_state;
    w[9] = reason;
    put32(w + 10, (uint32_t)(int32_t)(position * 1e4 + 0.5));
    put32(w + 12, (uint32_t)(int32_t)(force() * 1e5 + 0.5));
    w[14] = check(w, 14);
}

static void show_identity(void)
{
    uint16_t *w = map->tab_input_registers + 32;
    const char model[16] = "libmodbus peer";
    w[0] = 0x4652;
    w[1] = 1;
    for (int k = 0; k < 8; k++) w[2 + k] = (uint8_t)model[2 * k] << 8 | (uint8_t)model[2 * k + 1];
    put32(w + 10, 7);
    w[12] = 316;
    const float numbers[3] = {50, 60, 20};
    for (int k = 0; k < 3; k++) {
        uint32_t raw;
        memcpy(&raw, numbers + k, 4);
        put32(w + 13 + 2 * k, raw);
    }
}

static void serve(modbus_t *ctx, const uint8_t *query, int length)
{
    static uint16_t echo = 0;
    const uint8_t *pdu = query + modbus_get_header_length(ctx);
    int write_at = pdu[0] == 16 ? pdu[1] << 8 | pdu[2] : pdu[0] == 23 ? pdu[5] << 8 | pdu[6] : -1;
    const uint8_t *data = pdu[0] == 16 ? pdu + 6 : pdu + 10;
    run_on();
    if (write_at == FEED) { /* before the reply, which reads the status in the same request */
        uint32_t feed = (uint32_t)data[0] << 24 | data[1] << 16 | data[2] << 8 | data[3];
        echo = data[4] << 8 | data[5];
        if (feed > last_feed && feed <= tick) last_feed = feed;
    }
    show_status(echo);
    modbus_reply(ctx, query, length, map);
    if (write_at == COMMAND && pdu[5] == 2 * COMMAND_WORDS) take_command();
}

int main(int count, char **words)
{
    if (count != 3) return 2;
    int serial = strcmp(words[1], "rtu") == 0, listening = -1;
    modbus_t *ctx = serial ? modbus_new_rtu(words[2], 115200, 'N', 8, 1) : modbus_new_tcp("127.0.0.1", atoi(words[2]));
    map = modbus_mapping_new(0, 0, REGISTERS, REGISTERS);
    if (!ctx || !map) return 1;
    modbus_set_slave(ctx, 1);
    clock_gettime(CLOCK_MONOTONIC, &began);
    show_identity();
    if (serial ? modbus_connect(ctx) : (listening = modbus_tcp_listen(ctx, 1)) < 0) {
        fprintf(stderr, "%s\n", modbus_strerror(errno));
        return 1;
    }
    puts("ready");
    fflush(stdout);
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    for (;;) {
        if (!serial && modbus_tcp_accept(ctx, &listening) < 0) return 0;
        for (;;) {
            int length = modbus_receive(ctx, query);
            if (length > 0) serve(ctx, query, length);
            else if (length < 0 && !serial) break;
        }
        modbus_close(ctx);
    }
}
